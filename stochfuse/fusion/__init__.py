"""Rules for fusing estimates and measurements, one a file: pure functions over stacks of arrays, no network.

    intersection, intersection_weights   (split) covariance intersection, and the weights that it needs
    blender, parallel                     filters side by side, joined with known cross-covariance
    equivalent                            correlated and uncertain noises, fused before one filter
    cooperative                           what two nodes measure of each other: LWIN and ITNS
    extended, inertial, trajectory        filters and error models of navigation

It knows the room of the kernel.  The estimators (`stochfuse.estimators`) carry these rules over lossy links.  A new
rule is one file: checks of what comes from outside, then the equations, batches in front.

For arrays of one's own the rules are doors here too: `sf.fusion.covariance_intersection`, `sf.fusion.blend`, ….
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Criterion": "intersection",
    "Signal": "intersection",
    "covariance_intersection": "intersection",
    "split_covariance_intersection": "intersection",
    "fuse_stack": "intersection",
    "blend": "blender",
    "blend_all": "blender",
    "blend_tree": "blender",
    "ParallelFilter": "parallel",
    "parallel_filters": "parallel",
    "cross_covariance": "parallel",
    "equivalent_measurement": "equivalent",
    "independent_measurement": "equivalent",
    "relation": "cooperative",
    "attitude": "cooperative",
    "time_transfer": "cooperative",
    "linear": "cooperative",
    "together": "cooperative",
    "lwin_update": "cooperative",
    "itns_update": "cooperative",
    "NonlinearModel": "extended",
    "extended_filter": "extended",
    "extended_step": "extended",
}
"""Rules that may be asked for here, and their files; loaded when first used."""


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'stochfuse.fusion' has no attribute '{name}'")
    return getattr(import_module(f"stochfuse.fusion.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(_HOME)
