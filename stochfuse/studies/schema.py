"""The structure of a study file, for pydantic.

    schema = "stochfuse.study/1"
    scenario = "cv-2d"                                    # a preset, a file, or a [scenario] table
    [vary]                                                # scenario keys, and method, estimator, …
    "network.link" = { from = 0, to = 1, number = 11 }
    "model.R" = { from = 1, to = 1e4, number = 13, scale = "log" }
    method = ["simplified", "general"]
    [design]                                              # default: the grid of all combinations
    kind = "latin-hypercube"
    points = 1000
    [predict]                                             # what holds for every point
    [report]                                              # what is tabulated
    quantity = ["claimed", "messages"]

Whether the values fit the scenario is found out point by point, see `stochfuse.studies.evaluation`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, Strict

from stochfuse.names import CRITERIA, ESTIMATORS, METHODS
from stochfuse.tables.base import Number, Table

Words = str | list[str]


class RangeTable(Table):
    """Values from … to …: as many as `number`, or any of them in a Latin hypercube."""

    from_: Number = Field(alias="from")
    to: Number
    number: int | None = Field(None, ge=1, strict=True, description="how many, both ends included")
    scale: Literal["linear", "log"] = "linear"
    whole: bool = Field(False, strict=True, description="round to whole numbers")


class DesignTable(Table):
    """How the varied values are combined into points."""

    kind: Literal["grid", "list", "latin-hypercube"] = Field(
        "grid", description="all combinations; the first, the second … values of all; or random ones, evenly spread"
    )
    points: int | None = Field(None, ge=1, strict=True, description="number of points of a Latin hypercube")
    seed: int | None = Field(None, ge=0, strict=True, description="of a Latin hypercube, default 1")


class PredictTable(Table):
    """How every point is predicted; see `stochfuse predict --help`."""

    method: Literal[METHODS] | None = None  # type: ignore[valid-type]
    estimator: Literal[ESTIMATORS] | None = None  # type: ignore[valid-type]
    criterion: Literal[CRITERIA] | None = None  # type: ignore[valid-type]
    runs: int | None = Field(None, ge=2, strict=True)
    seed: int | None = Field(None, ge=0, strict=True)
    max_graphs: int | None = Field(None, ge=1, strict=True)
    prune: bool | None = Field(None, strict=True)


class StudyReportTable(Table):
    """What is tabulated of every point and step."""

    quantity: Words = Field("claimed", description="as --quantity takes them, and messages (nodes received)")
    metric: Words | None = Field(None, description="as --metric takes them; default: the scenario's, else trace")
    agent: Annotated[int, Strict(), Field(ge=1)] | Literal["mean", "worst", "best"] | None = Field(
        None, description="whose covariance; default: the scenario's, else the mean"
    )


EXPECTED = {
    "scenario": "a preset's name, a file, or a table",
    "vary": "a table of keys with their values",
    "report.agent": "mean, worst, best or an agent's number",
    "report.quantity": "a quantity or a list of them",
    "report.metric": "a metric or a list of them",
}
"""What keys take that take several kinds of values."""


class StudyFile(Table):
    """A stochfuse study."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, title="stochfuse study", populate_by_name=False, serialize_by_alias=True
    )

    schema_: Literal["stochfuse.study/1"] = Field("stochfuse.study/1", alias="schema")
    description: str | None = None
    scenario: str | dict[str, Any] = Field("thesis-transient", description="preset, file (seen from here), or table")
    vary: dict[str, Any] = Field(description="what differs: lists of values, or {from, to, number}, by their keys")
    design: DesignTable = Field(default_factory=lambda: DesignTable.model_validate({}))
    predict: PredictTable = Field(default_factory=lambda: PredictTable.model_validate({}))
    report: StudyReportTable = Field(default_factory=lambda: StudyReportTable.model_validate({}))
