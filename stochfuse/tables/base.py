"""What the structures of all tables share."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Strict

Number = Annotated[int, Strict()] | Annotated[float, Strict()]


class Table(BaseModel):
    """A table: unknown keys are errors, and numbers that are not finite are left to the reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=True)
