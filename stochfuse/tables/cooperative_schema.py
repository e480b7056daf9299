"""The structure of [cooperative] in a scenario file, for pydantic; the numbers are checked by `cooperative_table`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, Strict

from stochfuse.tables.base import Number, Table

Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]


class PairTable(Table):
    """What one pair of agents measures, in place of what all pairs measure."""

    agents: list[Whole] = Field(description="the observer and the other, counted from 1")
    range: Number | None = Field(None, description="standard deviation of the distance; left out, none is measured")
    direction: Number | None = Field(
        None, description="standard deviation of the line of sight in rad; left out, none is measured"
    )
    none: Flag = Field(False, description="true: the two communicate and measure nothing of each other")
    both_ways: Flag = Field(True, description="whether the other measures the observer likewise, with noise of its own")


class CooperativeTable(Table):
    """Agents that measure each other: relative range, line-of-sight direction, or both."""

    positions: list[str] = Field(description="names of the 2 or 3 states that are the place")
    range: Number | None = Field(
        None, description="standard deviation of the distance of every pair, in the places' unit"
    )
    direction: Number | None = Field(
        None, description="standard deviation of the line of sight of every pair, in rad (of each of the two angles)"
    )
    pair: list[PairTable] | None = Field(None, description="pairs that measure otherwise")
