"""What can go wrong, said so that the user can mend it."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from importlib import import_module
from types import ModuleType
from typing import NamedTuple


def nearest(word: str, known: Iterable[str]) -> str:
    """Return ` (did you mean 'claimed'?)` where one of the known words is near, else nothing."""
    found = get_close_matches(str(word), list(known), n=1)
    return f" (did you mean '{found[0]}'?)" if found else ""


class Problem(NamedTuple):
    """One offending key: its path, what was expected there and what came."""

    path: str
    expected: str
    got: str

    def __str__(self) -> str:
        return f"{self.path}: expected {self.expected}, got {self.got}"


class StochfuseError(Exception):
    """Base of the errors that a user can mend."""


class ScenarioError(StochfuseError, ValueError):
    """A scenario that cannot be read or does not fit together; names every offending key.

    Parameters
    ----------
    source : where the scenario came from (a file's name, a preset's).
    problems : the offending keys, or one sentence where no key is to blame.
    """

    def __init__(self, source: str, problems: Iterable[Problem] | str):
        self.source = source = source if source.isprintable() else repr(source)
        self.problems = () if isinstance(problems, str) else tuple(problems)
        text = problems if isinstance(problems, str) else "".join(f"\n  {p}" for p in self.problems)
        super().__init__(f"{source}:{' ' if isinstance(problems, str) else ''}{text}")


class UsageError(StochfuseError, ValueError):
    """A request that does not fit the scenario or the method."""


class TooManyError(UsageError):
    """More outcomes than can be listed."""


class MessageError(StochfuseError, ValueError):
    """A message, or a saved agent, that cannot be what it should be; nothing of it was taken in."""


class NoAnswerError(StochfuseError):
    """The question has no answer: the filter diverges, the target cannot be reached.

    Parameters
    ----------
    message : why.
    items : places of the items of a batch that have none, where they are known.
    """

    def __init__(self, message: str = "", items: Iterable[int] = ()):
        self.items = tuple(items)
        super().__init__(message)


def needed(module: str, extra: str, what: str = "this needs") -> ModuleType:
    """Return a module that not everybody has.

    Parameters
    ----------
    extra : what of stochfuse's extras brings it.
    what : the beginning of the message.

    Raises
    ------
    StochfuseError
        If it is not installed; with the line that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        raise StochfuseError(f"{what} {missing}: pip install 'stochfuse[{extra}]'") from None
