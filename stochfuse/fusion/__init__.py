"""Rules for fusing estimates and measurements, one a file: pure functions over stacks of arrays, no network.

    intersection, intersection_weights   (split) covariance intersection, and the weights that it needs
    blender, parallel                     filters side by side, joined with known cross-covariance
    equivalent_measurement                correlated and uncertain noises, fused before one filter
    cooperative                           what two nodes measure of each other: LWIN and ITNS
    extended, inertial, trajectory        filters and error models of navigation

It knows the room of the kernel.  The estimators (`stochfuse.estimators`) carry these rules over lossy links.  A new
rule is one file: checks of what comes from outside, then the equations, batches in front.
"""
