"""`stochfuse methods`: what there is, what takes what, and why not."""

from __future__ import annotations

from typing import Annotated

from stochfuse.cli.options import SHOWN, Listed, option
from stochfuse.cli.values import named
from stochfuse.scenario.own_rules import OwnRule
from stochfuse.scenario.registry import LFG

EXAMPLES = ("stochfuse methods", "stochfuse methods --matrix")


def methods(
    matrix: Annotated[bool, option("Which estimator takes what, by which engine.", SHOWN, "--matrix")] = False,
    estimator: Annotated[
        str | None, option("Also this rule of your own, module:Class; several: a,b.", SHOWN, metavar="LIST")
    ] = None,
    to: Listed = Listed(),
) -> None:
    """Show what there is: estimators, engines, quantities, and what takes what.

    --estimator says what the agents do with what arrives, --method how chance is averaged.
    """
    from stochfuse.report.methods import methods_report

    to.check()
    to.write(methods_report(matrix, [name for name in named(estimator or LFG) if isinstance(name, OwnRule)]))
