"""The names by which users ask for methods, estimators and criteria."""

METHODS = ("simplified", "general", "optimal", "naive", "monte-carlo")
ESTIMATORS = (
    "local-fusion-graph",
    "naive",
    "optimal",
    "covariance-intersection",
    "split-ci",
    "blender",
    "joint-blender",
    "equivalent-measurement",
    "independent-measurements",
    "lwin",
    "itns",
    "stand-alone",
)
CRITERIA = ("det", "trace", "max-eig")
