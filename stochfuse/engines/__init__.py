"""How chance is averaged over: an engine drives any estimator, and knows none.

    mean_field      average after every step, then go on from the average
    enumeration     every outcome of which messages arrive; equal claims added up
    contact_chain   whose measurements an agent holds, walked backwards; `enclosure` where paths are too many
    contact_sample  the optimum of outcomes drawn, by Boolean products; `heard` stands in for it as a control
    monte_carlo     outcomes drawn

`events` has what may arrive in a step and how likely it is, `distribution` what can be asked of values with
probabilities, `precision` how far rounding reaches.  Engines take a system's numbers and events, never a scenario.  A
new chance event is one more kind in `events`; a new engine one file and its method in `stochfuse.prediction`.
"""
