"""Fusion rules of the user's own: a class by its name, loaded where a caller asks for it, never because a file says so.

What is loaded is a name that carries its rule (`OwnRule`).  It goes wherever names of estimators go (settings, results,
worker processes, titles), and nothing has to be registered; a string from a scenario file carries none, and stays
what it is, a word that names no estimator.  What a rule is asked for: `stochfuse.estimators.own`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from inspect import signature
from typing import TYPE_CHECKING, Any

from stochfuse.errors import UsageError, nearest
from stochfuse.scenario.registry import ESTIMATORS, EstimatorEntry

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

GROUP = "stochfuse.estimators"
"""Entry points of installed packages whose rules go by a short name."""
WHAT = "a class, or an object, with a method fuse(x, P)"


class OwnRule(str):
    """Name of a rule, with the rule; equal to another one of its name only if that has the same rule.

    Parameters
    ----------
    name : as it was asked for.
    rule : object with a method fuse(x, P), see `stochfuse.estimators.own`.
    """

    rule: Any

    def __new__(cls, name: str, rule: Any) -> OwnRule:
        """Make a name that carries a rule."""
        made = super().__new__(cls, name)
        made.rule = rule
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to other processes with the rule, which they import."""
        return OwnRule, (str(self), self.rule)

    def __eq__(self, other: object) -> bool:
        return str.__eq__(self, other) is True and getattr(other, "rule", self.rule) is self.rule

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = str.__hash__

    @property
    def entry(self) -> EstimatorEntry:
        """What the registry says of estimators."""
        rule, says = self.rule, (type(self.rule).__doc__ or "").strip().split("\n")[0].rstrip(".")
        return EstimatorEntry(
            self,
            getattr(rule, "title", says or "a fusion rule of one's own"),
            getattr(rule, "source", type(rule).__module__),
            f" of {self}",
            ("own", "OwnFusion"),
        )

    @property
    def refuses(self) -> Mapping[str, str]:
        """Features of a scenario that the rule does not take, and why."""
        return getattr(self.rule, "refuses", {})

    @property
    def travels(self) -> bool:
        """Whether worker processes can import it."""
        kind = type(self.rule)
        return kind.__module__ != "__main__" and "<" not in kind.__qualname__

    @property
    def ordered(self) -> bool:
        """Whether the order of those heard matters to the rule."""
        return bool(getattr(self.rule, "ordered", False) or getattr(self.rule, "pairs", False))


def estimator_named(given: Any, *, here: bool = False) -> str:
    """Return the name of an estimator, with the rule that it carries if it is the user's own.

    Parameters
    ----------
    given : name of an estimator; "package.module:Class"; name of an entry point of the group `GROUP`; or a class or an
        object with a method fuse(x, P).
    here : look for modules in the working folder too, as `python -m` does.

    Raises
    ------
    UsageError
        If there is no such estimator, or nothing that is one.
    """
    if isinstance(given, OwnRule) or given in ESTIMATORS:
        return given
    if not isinstance(given, str):
        return _named(_name_of(given), given)
    if ":" not in given:
        return _named(given, _installed(given))
    module, _, path = given.partition(":")
    if module.endswith(".py") or not all(part.isidentifier() for part in f"{module}.{path}".split(".")):
        hint = nearest(given, (f"{os.path.basename(module).removesuffix('.py')}:{path}",)) if module and path else ""
        raise UsageError(f"estimator: expected package.module:Class, names and no path of a file, got '{given}'{hint}")
    with _loading(given, here):
        found: Any = import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
    return _named(given, found)


@contextmanager
def _loading(given: str, here: bool = False) -> Iterator[None]:
    if here and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        yield
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise UsageError(f"estimator: expected package.module:Class to load, got '{given}' ({what})") from None


def _installed(given: str) -> Any:
    from importlib.metadata import entry_points

    found = {point.name: point for point in entry_points(group=GROUP)}
    if given not in found:
        known, dotted = (*ESTIMATORS, *found), () if given.endswith(".py") else (":".join(given.rsplit(".", 1)),)
        raise UsageError(
            f"estimator: expected one of {', '.join(known)}, or package.module:Class, got '{given}'"
            f"{nearest(given, (*known, *dotted) if '.' in given else known)}"
        )
    with _loading(given):
        return found[given].load()


def _name_of(given: Any) -> str:
    kind = given if isinstance(given, type) else type(given)
    own = getattr(given, "name", None)
    return own if isinstance(own, str) else f"{kind.__module__}:{kind.__qualname__}"


def _named(name: str, given: Any) -> OwnRule:
    if not callable(getattr(given, "fuse", None)):
        raise UsageError(f"estimator: expected one of {', '.join(ESTIMATORS)}, or {WHAT}, got {name}, which has none")
    rule = _made(given) if isinstance(given, type) else given
    try:
        taken = signature(rule.fuse)
    except (TypeError, ValueError):  # of compiled code, which cannot be looked at
        return OwnRule(name, rule)
    try:
        taken.bind(None, None)
    except TypeError:
        raise UsageError(
            f"estimator {name}: expected a method fuse(self, x, P), got one called by fuse{taken}"
        ) from None
    return OwnRule(name, rule)


@lru_cache(maxsize=64)
def _made(kind: type) -> Any:
    """One object of a class, the same for all who name it."""
    try:
        return kind()
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise UsageError(
            f"estimator {_name_of(kind)}: expected a class that is made without arguments, or an object of it ({what})"
        ) from None


def estimators_named(given: Any, *, here: bool = False) -> tuple[str, ...]:
    """Return the names of one or several estimators; see `estimator_named`.

    Raises
    ------
    UsageError
        If one is none, or named twice.
    """
    one_by_one: Sequence[Any] = given if isinstance(given, list | tuple) else (given,)
    names = tuple(estimator_named(each, here=here) for each in one_by_one)
    if len({str(name) for name in names}) < len(names):
        raise UsageError(f"estimator: expected different ones, got {', '.join(names)}")
    return names
