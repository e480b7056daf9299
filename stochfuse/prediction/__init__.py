"""From a scenario to a prediction: estimator × engine → expected covariance and what it means.

    predict          `predict`, `predict_several`, `predict_many`: one request, any method; `swept`: against any number
    simplified, general, optimal, sampled     the methods: a system and items in, `method.Averaged` out
    control, stopping                         what a sample does with the optimum beside it, and when it may stop
    states, expected_states                   estimates given what was measured: (53), and of any method
    limits           the steady state of any prediction; of (54) `steady_state`, of the optimum `steady_chain`
    boundedness      whether (54) has one
    compare          methods, or estimators, side by side
    interval         what a log leaves unknown of its links, carried on
    result, quantities                        what users hold, and what can be shown of it

It knows the rooms below.  A new method is one file with a function `averaged`, and its entry in the registry.
"""
