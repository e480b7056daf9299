"""stochfuse: how good a fused estimate will be, as a function of the link probability.

    >>> import stochfuse as sf
    >>> s = sf.load_scenario("thesis-transient")
    >>> p = sf.predict(s, link=[0, 0.25, 0.5])
    >>> p.covariance.shape                     # link, step, state, state
    (3, 5, 1, 1)

`sf.kalman` and `sf.fusion` are doors to the filter's equations and to the rules of fusion for arrays of one's own,
`sf.thesis` to what the thesis found.
Names are loaded when first used, so that the command line starts without what it does not need.  They are listed in
`__init__.pyi`.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

_ROOMS = ("fusion", "kalman", "scenario", "thesis")
_LISTED = re.findall(
    r"^from (stochfuse\.\S+) import (\w+) as", Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"), re.M
)
_HOME = {name: home for home, name in _LISTED}

__all__ = ["__version__", *sorted([*_HOME, "scenario"])]


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"stochfuse.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'stochfuse' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def shown(name: str, *args: Any, **kwargs: Any) -> Any:
    """Call a function of `stochfuse.report.results`: the door through which a result reaches what shows it."""
    return getattr(import_module("stochfuse.report.results"), name)(*args, **kwargs)


def __dir__() -> list[str]:
    return __all__
