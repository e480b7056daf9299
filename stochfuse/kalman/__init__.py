"""The ground: the Kalman filter's equations, once for numbers and symbols, and covariances as numbers.

Doors: `kernel` (predict, update, in covariance, information and square-root form; the only copy) and `metrics` (one
number out of a covariance, moments of an error).  `averaged_update` and `arrivals` average the update over a number
of arriving measurements, (54); `algebra` is what differs between NumPy and SymPy; `checks` says why a matrix is no
covariance.

It knows nothing but NumPy: no scenario, no network, no chance but the number of arrivals.  A new form of predict or
update goes into `kernel`, over the same `algebra`; a new metric into `metrics`, with its entry in
`stochfuse.scenario.registry`.
"""
