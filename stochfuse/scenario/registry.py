"""What can be asked of a scenario: every estimator, engine, quantity, metric and statistic, declared once.

What the agents do (`EstimatorEntry`) and how chance is averaged (`EngineEntry`) are two choices;
`stochfuse.scenario.capabilities` says which pair takes what.  Choices and help of the command line, titles, error
messages and `stochfuse methods` are made from these entries.  It lies in this room because a scenario file's [report]
names what is declared here.  To add an estimator: one entry here, its file in `stochfuse.estimators`, its row in the
tests' matrix.
"""

from __future__ import annotations

from typing import NamedTuple

LFG, NAIVE, OPTIMAL, STAND_ALONE = "local-fusion-graph", "naive", "optimal", "stand-alone"
SIMPLIFIED, GENERAL, CHAIN, MONTE_CARLO = "simplified", "general", "chain", "monte-carlo"
BROADCAST_PRIOR = "broadcast-prior"
"""What the simplified formulation takes the agents to do: they share the broadcast prior and nothing else."""


class EstimatorEntry(NamedTuple):
    """What the agents do with what arrives.

    Parameters
    ----------
    name : as users type it.
    title : what it is, for a list.
    source : equation or work that it is from.
    of : how a title ends that says whose estimates are shown.
    place : file in `stochfuse.estimators`, and class.
    sums : whether its estimates are sums of information, so that what is common can be told before any number; the
        others write down pasts.
    weighs : whether its weights minimise a criterion.
    own_states, own_filters : whether agents may have states, or filters of a common state, of their own.
    footprints : whether it carries its error along as coefficients on all noises.
    not_live : what its fusion needs beside estimates that were heard, so that it is no live agent's; else empty.
    cites : keys of its sources beside the thesis, see `stochfuse.report.citations`.
    """

    name: str
    title: str
    source: str
    of: str
    place: tuple[str, str]
    sums: bool = False
    weighs: bool = False
    own_states: bool = False
    own_filters: bool = False
    footprints: bool = True
    cites: tuple[str, ...] = ()
    not_live: str = ""


class EngineEntry(NamedTuple):
    """How chance is averaged.

    Parameters
    ----------
    name : as users type it after --method.
    title, source : what it is, and the equations or the work that it is from.
    nature : what its numbers are.
    help : one line.
    file : in `stochfuse.prediction`.
    """

    name: str
    title: str
    source: str
    nature: str
    help: str
    file: str


class Short(NamedTuple):
    """A short form of --method: an estimator with an engine."""

    name: str
    estimator: str
    engine: str


class Quantity(NamedTuple):
    """What is shown of an estimate's error.

    Parameters
    ----------
    name, title, help : as users type it, and in words.
    error : whether the estimate's true error has to be followed.
    """

    name: str
    title: str
    help: str
    error: bool


class Measure(NamedTuple):
    """A metric (one number out of a covariance), or a statistic of it over the outcomes, as users type it."""

    name: str
    help: str


ESTIMATOR = (
    EstimatorEntry(
        LFG,
        "common information removed by the Local Fusion Graph",
        "thesis, chapter 2 and appendix A",
        " of the Local Fusion Graph",
        ("local_fusion_graph", "LocalFusionGraph"),
        sums=True,
    ),
    EstimatorEntry(
        NAIVE,
        "estimates added up, nothing removed",
        "thesis, (42)/(43)",
        " of naive fusion (42)/(43)",
        ("naive", "NaiveFusion"),
        sums=True,
    ),
    EstimatorEntry(
        OPTIMAL,
        "the best that any linear fusion could do with what arrived",
        "one filter over every measurement in the pedigree",
        ": the best that linear fusion can do with what arrived",
        ("optimal", "OptimalFusion"),
        sums=True,
    ),
    EstimatorEntry(
        "covariance-intersection",
        "everything taken for possibly correlated",
        "Julier and Uhlmann 1997",
        " of covariance intersection",
        ("intersection", "CovarianceIntersection"),
        cites=("julier1997",),
        weighs=True,
        own_states=True,
    ),
    EstimatorEntry(
        "split-ci",
        "everything but the step's own measurement taken for possibly correlated",
        "patent on split covariance intersection",
        " of split covariance intersection",
        ("intersection", "SplitCovarianceIntersection"),
        cites=("julier2004",),
        weighs=True,
        own_states=True,
    ),
    EstimatorEntry(
        "blender",
        "parallel filters blended in a tree, two at a time",
        "parallel filters, (19)–(30)",
        " of a tree of blenders",
        ("blender", "Blender"),
        cites=("layh2017",),
        own_filters=True,
    ),
    EstimatorEntry(
        "joint-blender",
        "parallel filters blended all at once",
        "parallel filters, least trace of all",
        " of the joint blender",
        ("blender", "JointBlender"),
        cites=("layh2017",),
        own_filters=True,
    ),
    EstimatorEntry(
        "equivalent-measurement",
        "measurements exchanged, their noises correlated and uncertain",
        "extended Kalman filter with uncertain fusion",
        " of the equivalent measurement",
        ("equivalent", "EquivalentMeasurement"),
        cites=("uncertain-fusion",),
        footprints=False,
        not_live="measurements of one platform, which are exchanged in the place of estimates",
    ),
    EstimatorEntry(
        "independent-measurements",
        "measurements exchanged and taken for independent",
        "the same with R taken for block diagonal",
        " of measurements taken for independent",
        ("equivalent", "IndependentMeasurements"),
        cites=("uncertain-fusion",),
        footprints=False,
        not_live="measurements of one platform, which are exchanged in the place of estimates",
    ),
    EstimatorEntry(
        "lwin",
        "cooperative measurements, each node for itself",
        "patent on cooperative estimators",
        " of LWIN",
        ("cooperative", "Lwin"),
        cites=("li2021",),
        own_states=True,
    ),
    EstimatorEntry(
        "itns",
        "cooperative measurements, one total covariance",
        "patent on cooperative estimators, (27)",
        " of ITNS",
        ("cooperative", "Itns"),
        cites=("li2021",),
        own_states=True,
        footprints=False,
        not_live="a centre that keeps one covariance for all agents",
    ),
    EstimatorEntry(
        STAND_ALONE,
        "no fusion: every agent's own filter",
        "thesis, (23)–(27)",
        " without fusion",
        ("stand_alone", "StandAlone"),
        own_states=True,
    ),
)
ENGINE = (
    EngineEntry(
        SIMPLIFIED,
        "simplified formulation (54)",
        "thesis, (50)–(54)",
        "approximate (mean field)",
        "average after every step, then go on from the average; of the broadcast prior alone",
        "simplified",
    ),
    EngineEntry(
        GENERAL,
        "general formulation (49)",
        "thesis, (44)–(49)",
        "exact",
        "go through every outcome of which messages arrive",
        "general",
    ),
    EngineEntry(
        CHAIN,
        "contact chain",
        "whose measurements an agent holds, walked backwards",
        "exact, or bounds",
        "follow how many agents' measurements are held; of the optimum alone",
        "optimal",
    ),
    EngineEntry(
        MONTE_CARLO,
        "Monte Carlo",
        "sampled outcomes",
        "sampled",
        "draw which messages arrive, --runs times for each link probability",
        "sampled",
    ),
)
REPLAY = EngineEntry(
    "replay",
    "replay",
    "one outcome of (45)/(46), with what was measured",
    "realised",
    "follow one record of what arrived: run, simulate",
    "",
)
"""The engine that averages nothing, and is no --method."""
SHORT = (Short(NAIVE, NAIVE, GENERAL), Short(OPTIMAL, OPTIMAL, CHAIN))
QUANTITY = (
    Quantity("claimed", "claimed {stage} covariance", "what the fusion rule itself reports", False),
    Quantity("actual", "actual {stage} error covariance", "what its error truly has", True),
    Quantity(
        "optimal", "optimal {stage} covariance", "the best that any linear fusion could do with what arrived", False
    ),
    Quantity("consistency", "{stage} consistency, actual / claimed (> 1: overconfident)", "actual / claimed", True),
    Quantity("bias", "{stage} bias from the initial error", "what is left of a known initial error", True),
    Quantity("rms", "root-mean-square {stage} error (noise and bias)", "root of the mean squared error", True),
)
STATE = "state"
"""What is asked for of a record of measurements, in the place of a quantity of the error."""
METRIC = (
    Measure("trace", "sum of all variances"),
    Measure("det", "determinant"),
    Measure("max-eig", "largest eigenvalue"),
    Measure("var:STATE", "variance of a state"),
    Measure("std:STATE", "its root"),
    Measure("rms:STATE,STATE,…", "root of the summed variances of some states"),
)
STATISTIC = (
    Measure("mean", "expectation"),
    Measure("variance", "variance over the outcomes"),
    Measure("std", "standard deviation over the outcomes"),
    Measure("quantile:P", "what is not exceeded with probability P"),
    Measure("at-most:LIMIT", "probability that it is at most the limit"),
    Measure("derivative", "derivative of the expectation in µ"),
)
CRITERIA = ("det", "trace", "max-eig")
"""What the weights of an intersection minimise."""
OPTIMUM, NO_CONTROL = "optimum", "none"
CONTROLS = (OPTIMUM, NO_CONTROL)
"""What a sample is corrected by."""
NATURES = ("exact", "sampled", "bound", "approximate")
"""What numbers may be, the most certain first."""

ESTIMATORS = tuple(e.name for e in ESTIMATOR)
ENGINES = tuple(e.name for e in ENGINE)
METHODS = (SIMPLIFIED, GENERAL, CHAIN, OPTIMAL, NAIVE, MONTE_CARLO)
"""What --method takes: the engines, and the short forms."""
QUANTITIES = tuple(q.name for q in QUANTITY)
CLAIMED, ACTUAL, RMS = AS_FORMULAS = ("claimed", "actual", "rms")
"""Quantities that there are as formulas."""
INTERSECTIONS = tuple(e.name for e in ESTIMATOR if e.weighs)
SUMS = tuple(e.name for e in ESTIMATOR if e.sums)


def estimator(name: str) -> EstimatorEntry:
    """Return the entry of an estimator; a rule of the user's own brings its own, see `stochfuse.scenario.own_rules`."""
    return getattr(name, "entry", None) or next(e for e in ESTIMATOR if e.name == name)


def engine_of(method: str) -> EngineEntry:
    """Return the engine behind what --method takes."""
    name = next((s.engine for s in SHORT if s.name == method), method)
    return next(e for e in ENGINE if e.name == name)


def quantity(name: str) -> Quantity:
    """Return the entry of a quantity."""
    return next(q for q in QUANTITY if q.name == name)


def title(method: str, estimator_name: str) -> str:
    """Return method and estimator in words: 'general formulation (49) of the Local Fusion Graph'."""
    whose = "" if estimator_name == BROADCAST_PRIOR else estimator(estimator_name).of
    return engine_of(method).title + whose
