"""From a scenario to a prediction: estimator × engine → expected covariance and what it means.

Doors: `predict.predict`, `predict_several`, `predict_many`; `compare`; `states.predict_states`.  `simplified`
(50)–(54), `general` (44)–(49), `optimal` and `sampled` are the methods: each takes a system and items and gives
`method.Averaged`; `result.Prediction` is what users hold, `quantities` what can be shown of it, `steady_state` the
recursion's fixed point, `boundedness` whether there is one.

It knows the rooms below.  A new method is one file with a function `averaged`, and its entry in the registry.
"""
