"""What is answered: the quick engines first, the exact ones behind them, and nothing of what was asked before.

Answers are the command line's: `predict`, `compare`, `solve --target`, `solve --sensitivity` and `messages`, read by
the views that print its tables.  `Work` follows one question at a time in a thread of its own; when the next is asked,
the one before ends at its next sign of life (`stochfuse.estimators.progress`), and what it still says is dropped.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

from stochfuse.errors import StochfuseError, TooManyError
from stochfuse.estimators.progress import Progress, listening
from stochfuse.explore.network import Picture, picture
from stochfuse.explore.state import COARSE, FINE, POWER, ROUGH, RUNS, PageInput, links_of
from stochfuse.prediction.compare import compare_estimators
from stochfuse.prediction.predict import EASY, EASY_EXCHANGE, exchange_of, predict_several
from stochfuse.questions.least_link import least_link
from stochfuse.questions.messages import RULES, message_load
from stochfuse.questions.sensitivity import sensitivity
from stochfuse.report.predictions import WIDTH_95, PredictionView
from stochfuse.scenario.registry import GENERAL, MONTE_CARLO, NO_CONTROL, OPTIMAL, SIMPLIFIED
from stochfuse.scenario.scenario import Scenario

LEVEL = 0.95
FIRST_RUNS = 20
"""Runs of a sample that is there soon."""
EVERY = 0.4
"""Seconds between what is said of how far it is."""
AT_ONCE = threading.Semaphore(2)
"""Exact engines at work at a time, of all pages together."""


class Line(NamedTuple):
    """Values along an axis, with a band where there is one.

    Parameters
    ----------
    x, y : (points,) in order.
    low, high : (points,) ends of a 95 % interval, or None.
    """

    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None


class Curve(NamedTuple):
    """One engine's or estimator's answer, of one quantity.

    Parameters
    ----------
    name : "simplified", "optimal" or an estimator's.
    quantity : "claimed", "actual", ….
    how : how exact it is, in words.
    over : along link probability or power, at the last step.
    steps : along the steps, at the present links.
    views : what was shown, along the one and the other; one view where they are the same.
    sampled : whether it was drawn.
    """

    name: str
    quantity: str
    how: str
    over: Line
    steps: Line
    views: tuple[PredictionView, ...]
    sampled: bool = False


class PageAnswer(NamedTuple):
    """Something in words and numbers.

    Parameters
    ----------
    text : in one sentence.
    value : the number, where it is one; of message loads (rules, steps).
    """

    text: str
    value: Any = None


def quick(asked: PageInput) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Questions whose answers come at once, by name, in the order of their hardness."""
    yield SIMPLIFIED, lambda: _predicted(asked, SIMPLIFIED)
    yield "network", lambda: picture(asked)
    yield "sensitivity", lambda: _with_sensitivity(asked)


def least(asked: PageInput) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The question that a dragged target asks again and again."""
    if asked.target is not None:
        yield "least", lambda: _least(asked)


def exact(asked: PageInput) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Questions whose answers may take their time; of what has to be sampled a few runs first, with wide bands."""
    if _sampled(asked.scenario, [asked.link] if asked.kind == "link" else None):
        for name in asked.estimators:
            yield f"estimator {name}", lambda name=name: _estimated(asked, name, runs=FIRST_RUNS, control=NO_CONTROL)
    yield OPTIMAL, lambda: _predicted(asked, OPTIMAL)
    yield "messages", lambda: _load(asked)
    for name in asked.estimators:
        yield f"estimator {name}", lambda name=name: _estimated(asked, name, runs=RUNS)


def _sampled(scenario: Scenario, links: Any) -> bool:
    """Whether the outcomes of an exchange are too many to be listed unasked."""
    return exchange_of(scenario, links) > EASY_EXCHANGE


def _predicted(asked: PageInput, method: str) -> list[Curve]:
    if not {"claimed", "actual"} & set(asked.quantities):
        return []

    def at(scenario: Scenario, links: Any, over: Any, alone: bool) -> list[Any]:
        counted = alone and method == SIMPLIFIED and scenario.network.counts is not None
        more: dict[str, Any] = {"over": over} if over else {"interval": LEVEL} if counted else {}
        return predict_several(scenario, links, method, ["claimed"], **more)

    return _curves(asked, method, ("claimed",), FINE, at)


def _estimated(asked: PageInput, name: str, **drawn: Any) -> list[Curve]:
    """As `compare` does it unasked: exactly where that is easy, else sampled, by fewer runs and links."""

    def by(method: str, **settings: Any) -> Callable[..., list[Any]]:
        def at(scenario: Scenario, links: Any, over: Any, alone: bool) -> list[Any]:
            asks = {"quantities": asked.quantities, **settings, **({"over": over} if over else {})}
            if method == GENERAL and _sampled(scenario, links):
                raise TooManyError
            found = compare_estimators(scenario, links, [name], method, **asks)
            return [found.predictions[0].shown_as(quantity) for quantity in asked.quantities]

        return at

    try:
        return _curves(asked, name, asked.quantities, COARSE, by(GENERAL, max_graphs=EASY))
    except TooManyError:
        # in this process, where it can be given up
        return _curves(asked, name, asked.quantities, ROUGH, by(MONTE_CARLO, workers=1, **drawn))


def _curves(
    asked: PageInput, name: str, quantities: Sequence[str], grid: str, at: Callable[..., list[Any]]
) -> list[Curve]:
    """Ask along the axis and at the present links, in one go where the one contains the other."""
    metric, agent, kind = asked.measure, asked.agent, asked.kind

    def viewed(predictions: Sequence[Any]) -> list[PredictionView]:
        return [PredictionView(p, metric, agent) for p in predictions]

    if kind == "link":
        along = present = viewed(at(asked.scenario, [*links_of(grid), asked.link], None, False))
        x = np.array([*links_of(grid), asked.link])
        own = len(x) - 1
    elif kind == "power":
        along = present = viewed(at(asked.scenario, None, {POWER: asked.powers(grid)}, False))
        x = np.array(asked.powers(grid))
        own = len(x) // 2
    else:
        along = viewed(at(asked.alike, links_of(grid), None, False))
        present = viewed(at(asked.scenario, None, None, True))
        x, own = np.array(links_of(grid)), 0
    found = []
    for quantity, view, here in zip(quantities, along, present, strict=True):
        order = np.unique(x, return_index=True)[1]
        over, steps = _line(x[order], view, (order, -1)), _line(here.steps, here, (own, slice(None)))
        views = (view,) if here is view else (view, here)
        found.append(Curve(name, quantity, here.how, over, steps, views, view.sampled))
    return found


def _line(x: np.ndarray, view: PredictionView, pick: Any) -> Line:
    y, errors, ends = view.values()[pick], view.errors(), view.ends()
    if errors is not None:
        return Line(x, y, y - WIDTH_95 * errors[pick], y + WIDTH_95 * errors[pick])
    return Line(x, y) if ends is None else Line(x, y, ends[0][pick], ends[1][pick])


def _least(asked: PageInput) -> PageAnswer:
    """The least link probability that meets the target."""
    if asked.kind != "link":
        return PageAnswer("The least µ for a target is asked of links that are all alike.")
    found = least_link(asked.alike, asked.target or 0.0, of=asked.metric, agent=asked.agent, method=SIMPLIFIED)
    return PageAnswer(f"Least µ for {asked.target:g}: {found.link:.9g} ({SIMPLIFIED})", float(found.link))


def _with_sensitivity(asked: PageInput) -> Picture:
    """The network with what each link is worth."""
    drawn = picture(asked)
    at = asked.link if asked.kind == "link" else None
    found = sensitivity(asked.scenario, at, of=asked.metric, agent=asked.agent, method=SIMPLIFIED)
    pairs = [[(receiver - 1, sender - 1) for receiver in receivers] for sender, receivers in found.links]

    def by_pair(values: np.ndarray) -> dict[tuple[int, int], float]:
        return {pair: float(value) for some, value in zip(pairs, values, strict=True) for pair in some}

    first = frozenset(pair for i in found.first for pair in pairs[i])
    return replace(drawn, worth=by_pair(found.derivative), lacking=by_pair(found.lacking), first=first)


def _load(asked: PageInput) -> PageAnswer:
    """Mean nodes that the messages of a step bring an agent, of both rules at every step."""
    link = [asked.link] if asked.kind == "link" and asked.link is not None else None
    agent = asked.agent if isinstance(asked.agent, int) else "mean"
    loads = [message_load(asked.scenario, link, rule) for rule in RULES]
    by_step = np.array([[load.between(k, k).mean(agent)[0] for k in load.steps] for load in loads])
    means = ", ".join(f"{load.rule} {load.mean(agent)[0]:.5g}" for load in loads)
    return PageAnswer(f"Nodes new to an agent per step, mean over the steps: {means} (exact)", by_step)


class QuestionWorker:
    """Follows the question that was asked last, in a thread.

    Parameters
    ----------
    deliver : told a question's number, the name of an answer, and the answer; or an error; or a text of how far it is,
        by the name "progress"; or None by the name "done".  Called from the thread.
    jobs : what is asked in turn; what comes behind the first waits until not too much is being done.
    """

    def __init__(self, deliver: Callable[[int, str, Any], None], jobs: Sequence[Any] = (quick, exact)) -> None:
        self._deliver, self._jobs = deliver, jobs
        self.number = 0

    def ask(self, asked: PageInput) -> int:
        """Begin with a question, and give up the one before."""
        self.number += 1
        threading.Thread(target=self._follow, args=(self.number, asked), name="stochfuse-page", daemon=True).start()
        return self.number

    def stop(self) -> None:
        """Give up what is being done."""
        self.number += 1

    def _follow(self, number: int, asked: PageInput) -> None:
        first, *behind = self._jobs
        try:
            for name, job in first(asked):
                self._answer(number, name, job)
            if not behind:
                return
            with AT_ONCE:
                for name, job in (one for jobs in behind for one in jobs(asked)):
                    self.say(number, "progress", name)
                    self._answer(number, name, job)
            self.say(number, "done", None)
        except Superseded:
            pass

    def _answer(self, number: int, name: str, job: Callable[[], Any]) -> None:
        try:
            with listening(_Listener(self, number, name)):
                found = job()
        except (StochfuseError, MemoryError, ArithmeticError, np.linalg.LinAlgError) as error:
            found = error
        self.say(number, name, found)

    def say(self, number: int, name: str, found: Any) -> None:
        """Hand something on, unless another question has been asked.

        Raises
        ------
        Superseded
            If one has.
        """
        if number != self.number:
            raise Superseded
        self._deliver(number, name, found)


class Superseded(Exception):  # noqa: N818
    """Another question has been asked."""


class _Listener(Progress):
    def __init__(self, work: QuestionWorker, number: int, name: str) -> None:
        self._work, self._number, self._name, self._said = work, number, name, monotonic()

    def advance(self, what: str, done: int, total: int) -> None:
        """Hand on now and then how far it is; what is no longer asked ends here."""
        if self._number != self._work.number:
            raise Superseded
        if monotonic() - self._said > EVERY:
            self._said = monotonic()
            share = f", {done:,} of {total:,}" if total else ""
            self._work.say(self._number, "progress", f"{self._name}: {what}{share}")
