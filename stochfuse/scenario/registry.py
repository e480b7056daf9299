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
INTERSECTIONS = ("covariance-intersection", "split-ci")
"""Estimators whose weights minimise one of the criteria."""
CRITERIA = ("det", "trace", "max-eig")
