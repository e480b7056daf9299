"""What is wrong with a simulator: known mistakes, each tried for how well it explains the results.

A mistake makes another simulator (`stochfuse.data.mistakes`), and that shows other numbers (`supposed`),

    m = expected + mean of (what the mistaken simulator shows − what the right one shows)

over the same histories, where that is known better than what it shows by itself; over all outcomes, where these can be
listed.  It explains the results if the p of their T² (`fits`) is above the crosscheck's level, with the freedom of the
cells, less one for a number estimated, and no other one that does so spreads the runs far more as they are.

The likeliest comes first: of those that explain, by T² plus the logarithm of the number of runs for every number that
was estimated (Schwarz), plus how unlike the runs of each cell are spread (4 λ² of Kolmogorov and Smirnov's λ of two
samples, with slack for what is estimated); the others by how far the cells are off, Σ log(1 + z²), in which no cell
decides alone.  A mistake that explains no better than that nothing is wrong is none.  Where no single one explains,
pairs of the nearest are tried.  An unknown number is found by parabolas through the cells' means.

Some links and the first steps, to the first that is far off, are mostly enough to tell mistakes apart; what explains
these is tried on twice as many, as long as there are some and time is left.  A cause says which steps it was tried on.

Wrong links: µ of each row is estimated, from the polynomials of the general formulation where the prediction has them.
Dependent runs: the results would be right, with the number of runs that their own correlation leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import log
from time import monotonic
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stochfuse.data.cells import Cell, Judged
from stochfuse.data.fits import ROUNDING, Fit, Fits, Means, covariance_of
from stochfuse.data.mistakes import DEPENDENT, MISTAKES, WRONG_LINK, Mistake, Variant
from stochfuse.data.supposed import CLAIMED, ERROR, SQUARED, LinkMeans, Sampler, Simulator, exactly
from stochfuse.engines.distribution import Distribution
from stochfuse.errors import StochfuseError
from stochfuse.estimators.progress import listener
from stochfuse.kalman.metrics import metric as metric_of
from stochfuse.prediction.result import Prediction
from stochfuse.scenario.network import LinkRows, uniform_rows
from stochfuse.scenario.registry import BROADCAST_PRIOR, LFG
from stochfuse.scenario.system import System

if TYPE_CHECKING:
    from stochfuse.data.crosscheck import Verdict

ALPHA = 0.001
ROUGHLY, CLOSELY, FEW = (400, 400, 400, 150), 4000, 3
"""Runs of a sample: of every mistake, by 1, 2, 3 and more agents, and of those that may explain the results; agents up
to which links are as many as below."""
PATIENCE = 20.0
"""Seconds after which no other mistake is tried: of large networks the likeliest must do."""
WORTH = 1e-9
"""p-value from which on a mistake is looked at closely."""
NEAREST, PAIRED, LISTED = 6, 6, 8
"""Mistakes that are looked at closely, those tried in pairs, and causes named that do not explain."""
LINKS, CELLS, STEPS, LAST = 4, 60, (8, 8, 4, 3), 32
"""Links, cells of a link, and first steps, of 1, 2, 3 and more agents, that are looked at; the last that ever is."""
FAR = 5.0
"""Standard errors by which a step is far off."""
BETTER, SPREAD, CLOSE = 6.0, 40.0, 0.01
"""Least gain in T² over a right simulator, most by which the spread of the runs may be worse than another mistake's,
and gain in T² that ends a search."""
COMPLETE = 0.5
"""Share of runs with a value in every cell from which on the runs are taken, and not their means alone."""
DIFFERENT = 0.95
"""Share of runs with noise of their own below which runs are repeated."""
APPROXIMATE = "approximate-prediction"


class Cause(NamedTuple):
    """What may be wrong.

    Parameters
    ----------
    cause : name of the mistake; of two at once "a+b".
    explains : whether the results agree with a simulator that makes it.
    p : probability that such a simulator differs as much as the results do, or more.
    text : what it is, and how well it explains, in a line.
    estimate : the number that was estimated, or None.
    remaining : largest |z| over the cells that is left.
    of : the mistakes' names.
    until, last : the last step that was looked at, and the last of the results.
    """

    cause: str
    explains: bool
    p: float
    text: str
    estimate: float | None
    remaining: float
    of: tuple[str, ...]
    until: int = 0
    last: int = 0

    @property
    def scope(self) -> str:
        """In words, which steps were looked at where that is not all; else empty."""
        return f" of steps up to {self.until} (of {self.last})" if self.until < self.last else ""


class _ClosestMistake(NamedTuple):
    """A mistake, the way to make it that comes closest, and how close.

    Parameters
    ----------
    at : number that was estimated, where one was, in the variant's own terms.
    numbers : how many were.
    apart : how unlike the runs are spread, as a χ².
    refuted : whether the runs are spread far more like those of another mistake that has the same means.
    shown : the numbers in words; empty: `at`.
    """

    mistakes: tuple[Mistake, ...]
    variant: Variant | None
    fit: Fit
    at: float = 0.0
    numbers: int = 0
    apart: float = 0.0
    refuted: bool = False
    shown: str = ""


def diagnose(
    prediction: Prediction,
    rows: LinkRows,
    blocks: Sequence[LinkMeans],
    *,
    alpha: float = ALPHA,
) -> tuple[Cause, ...]:
    """Say what would explain results that disagree with a prediction.

    Parameters
    ----------
    prediction : what the results were compared with.
    rows : links that it was asked for.
    blocks : the results, one block for each link probability.
    alpha : probability that the right cause is said not to explain.

    Returns
    -------
    tuple of Cause
        The likeliest first; all that explain, and the nearest of those that do not.

    Raises
    ------
    UsageError
        If blocks name rows or agents that the prediction does not have.
    """
    blocks = [block for block in blocks if block.cells]
    tried, found, until = MISTAKES, (), monotonic() + PATIENCE
    for end in _ends(prediction, blocks):
        diagnosis = _Diagnosis(prediction, *_fewer(prediction, rows, blocks, end), alpha)
        causes = diagnosis.causes(tried, until)
        if found and not any(cause.explains for cause in causes):  # of more steps, what else?
            causes = diagnosis.causes(MISTAKES, until)
        if found and monotonic() > until:
            break
        found = tuple(cause._replace(until=end, last=_last(blocks)) for cause in causes)
        names = {name for cause in found if cause.explains for name in cause.of}
        if not names:
            break
        tried = tuple(mistake for mistake in MISTAKES if mistake.name in names)
    return found


def _last(blocks: Sequence[LinkMeans]) -> int:
    return max(cell.step for block in blocks for cell in block.cells)


def _ends(prediction: Prediction, blocks: Sequence[LinkMeans]) -> Iterator[int]:
    """Last steps to look at, one after another."""
    if not blocks:
        return
    cells, last = [cell for block in blocks for cell in block.cells], _last(blocks)
    first = max(_by_agents(STEPS, prediction), min(cell.step for cell in cells))
    far = min((cell.step for cell in cells if abs(cell.z) > FAR and cell.step <= LAST), default=0)
    end = min(last, max(first, far))
    yield end
    while end < min(last, LAST):
        end = min(2 * end, last, LAST)
        yield end


def _by_agents(numbers: Sequence[int], prediction: Prediction) -> int:
    return numbers[min(len(prediction.group_of), len(numbers)) - 1]


def _fewer(
    prediction: Prediction, rows: LinkRows, blocks: Sequence[LinkMeans], last: int
) -> tuple[LinkRows, System, Fits]:
    """As many links and cells as are enough, of steps up to the last."""
    most = LINKS if len(prediction.group_of) <= FEW else LINKS // 2
    blocks = [blocks[i] for i in np.unique(np.linspace(0, len(blocks) - 1, min(most, len(blocks))).astype(int))]
    found = []
    for number, block in enumerate(blocks):
        here = [i for i, cell in enumerate(block.cells) if cell.step <= last]
        here = [here[i] for i in np.unique(np.linspace(0, len(here) - 1, min(CELLS, len(here))).astype(int))]
        values = None if block.values is None else block.values[:, here]
        found.append(LinkMeans(block.link, number, tuple(block.cells[i] for i in here), values))
    chosen = rows.take(np.array([block.row for block in blocks]))
    if chosen.varies:
        chosen = replace(chosen, link=chosen.link[:, :last])
    return chosen, prediction.scenario.until(last).system, Fits(tuple(block for block in found if block.cells))


def causes_of(verdict: Verdict, judged: Sequence[Judged], rows: LinkRows) -> tuple[Cause, ...]:
    """Say what would explain a verdict that disagrees; empty where it agrees, or does not for its evidence alone.

    Parameters
    ----------
    judged : its cells, with the runs behind them.
    rows : links that its prediction was asked for.
    """
    level = verdict.alpha if verdict.p_together is None else verdict.alpha / 2
    if verdict.p_largest > level and (verdict.p_together is None or verdict.p_together > level):
        return ()
    return diagnose(verdict.prediction, rows, _blocks(judged), alpha=verdict.alpha)


def _blocks(judged: Sequence[Judged]) -> list[LinkMeans]:
    """Cells of every link probability, of steps up to `LAST` or the first one there is, with what each run has."""
    last = max(LAST, min((j.cell.step for j in judged), default=0))
    found = []
    for row in sorted({j.cell.row for j in judged}):
        mine = [j for j in judged if j.cell.row == row and j.cell.step <= last and np.isfinite(j.cell.mean)]
        if mine:
            cells = (j.cell if np.isfinite(j.cell.error) else j.cell._replace(error=0.0) for j in mine)
            found.append(LinkMeans(mine[0].cell.link, row, tuple(cells), _complete([j.runs for j in mine])))
    return found


def _complete(runs: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Runs that have a value in every cell, (runs, cells); None of means, or if too few have."""
    there = [values for values in runs if values is not None]
    if len(there) < len(runs):
        return None
    table = np.stack(there, axis=1)
    complete = ~np.isnan(table).any(axis=1)
    return table[complete] if complete.mean() >= COMPLETE and complete.sum() > 1 else None


def summary(causes: Sequence[Cause]) -> str:
    """Return in one line what was found."""
    explaining = [c for c in causes if c.explains]
    if explaining:
        first, others = explaining[0], [c.cause for c in explaining[1:]]
        so = f"; so {'does' if len(others) == 1 else 'do'} {', '.join(others)}" if others else ""
        if len(first.of) > 1:
            return f"likely cause: two faults, {' and '.join(first.of)}, together explain the numbers{first.scope}{so}"
        return f"likely cause: {first.cause} explains the numbers{first.scope}{so}"
    known = len(MISTAKES) + 2
    if not causes:
        return f"none of the {known} known mistakes can be tried on this scenario"
    nearest, scope = causes[0], causes[0].scope
    return (
        f"none of the {known} known mistakes explains the numbers{scope}; nearest "
        f"{' and '.join(nearest.of)}, leaves |z| up to {nearest.remaining:.3g}"
    )


@dataclass(frozen=True, eq=False)
class _Diagnosis:
    prediction: Prediction
    rows: LinkRows
    system: System
    results: Fits
    alpha: float

    def causes(self, mistakes: Sequence[Mistake], until: float) -> tuple[Cause, ...]:
        """All of it, of some mistakes and those that are found otherwise, for as long as there is time."""
        rough = _SimulatorTrials(self, _by_agents(ROUGHLY, self.prediction))
        nothing = self.results.judge(self.results.expected).distance
        tried = self._singles(rough, mistakes, until)
        best = [*self._closer(tried, until), *self._others(rough)]
        if not any(self._explains(t) for t in best):
            best += self._closer(self._pairs(rough, tried, until), until)
        best = [t for t in best if not self._explains(t) or t.fit.distance < nothing - BETTER]
        least = min((t.apart for t in best if self._explains(t)), default=0.0)
        best = [t._replace(refuted=self._explains(t) and t.apart > least + SPREAD) for t in best]
        ranked = sorted(best, key=self._rank)
        explaining = sum(map(self._explains, ranked))
        return tuple(map(self._cause, ranked[: max(LISTED, explaining)]))

    def _others(self, trial: _SimulatorTrials) -> list[_ClosestMistake]:
        found = (self._wrong_link(trial), self._dependent(trial), self._approximate(trial))
        return [t for t in found if t is not None]

    @property
    def base(self) -> Simulator:
        """The right simulator."""
        p = self.prediction
        estimator = LFG if p.estimator == BROADCAST_PRIOR else p.estimator
        return Simulator(self.system, self.rows, estimator, followed=self.results.errors)

    def _singles(self, trial: _SimulatorTrials, mistakes: Sequence[Mistake], until: float) -> list[_ClosestMistake]:
        found = []
        for number, mistake in enumerate(mistakes):
            if monotonic() > until:
                break
            listener().advance(f"trying {mistake.name}", number, len(mistakes))
            best = trial.best((mistake,), mistake.variants(self.base))
            found += [] if best is None else [best]
        return sorted(found, key=self._rank)

    def _pairs(
        self, trial: _SimulatorTrials, singles: Sequence[_ClosestMistake], until: float
    ) -> list[_ClosestMistake]:
        chosen = sorted(singles, key=lambda t: t.fit.off)[:PAIRED]
        pairs, found = list(combinations(chosen, 2)), []
        for number, (one, other) in enumerate(pairs):
            if monotonic() > until:
                break
            names = (*one.mistakes, *other.mistakes)
            listener().advance(f"trying {names[0].name} and {names[1].name}", number, len(pairs))
            best = trial.best(names, _together(one, other))
            found += [] if best is None else [best]
        return sorted(found, key=self._rank)

    def _closer(self, tried: Sequence[_ClosestMistake], until: float) -> list[_ClosestMistake]:
        """The same, of larger samples where that may decide."""
        near = [t for t in tried if t.fit.p > WORTH][:NEAREST]
        trial, out = _SimulatorTrials(self, min(CLOSELY, 2 * max(self.results.runs, ROUGHLY[0])), exactly=True), []
        for t in tried:
            variants = [t.variant] if t in near and t.variant is not None and monotonic() < until else []
            # a search that has found something begins anew around it
            variants = [v._replace(grid=(t.at - 0.05, t.at, t.at + 0.05)) if v.grid else v for v in variants]
            again = trial.best(t.mistakes, variants) if variants else None
            out.append(again or t)
        return out

    def _explains(self, t: _ClosestMistake) -> bool:
        return t.fit.p > self.alpha and not t.refuted

    def _rank(self, t: _ClosestMistake) -> tuple[float, ...]:
        price = log(max(2, self.results.runs)) * (t.numbers + len(t.mistakes) - 1)
        if self._explains(t):
            return (0.0, round(t.fit.distance + t.apart + price, 6))
        return (1.0, t.fit.off + price / max(1, t.fit.freedom))

    def _cause(self, t: _ClosestMistake) -> Cause:
        names = tuple(m.name for m in t.mistakes)
        seen = t.at if t.variant is None else t.variant.shown(t.at)
        what = " and ".join(m.text.format(t.shown or seen) for m in t.mistakes)
        what += f" ({t.variant.note})" if t.variant is not None and t.variant.note else ""
        two = "two faults: " if len(names) > 1 else ""
        left = f"largest |z| {t.fit.largest:.3g} at {t.fit.where}"
        how = f"explains all but p = {t.fit.p:.2g}"
        if t.refuted:
            how = f"explains the means (p = {t.fit.p:.2g}), not how the runs are spread"
        elif not self._explains(t):
            how = f"does not explain (p = {t.fit.p:.2g})"
        untold = f"; of {t.fit.untold} cells it says nothing" if t.fit.untold else ""
        text = f"{' and '.join(names)}: {two}{what}; {how}, {left}{untold}"
        return Cause(
            cause="+".join(names),
            explains=self._explains(t),
            p=t.fit.p,
            text=text,
            estimate=float(seen) if t.numbers else None,
            remaining=t.fit.largest,
            of=names,
        )

    def _wrong_link(self, trial: _SimulatorTrials) -> _ClosestMistake | None:
        """µ of every row as it would fit best."""
        curve = _curve(self.prediction, self.rows, self.results.blocks)
        if curve is None:
            return None
        listener().advance(f"trying {WRONG_LINK}", len(MISTAKES), len(MISTAKES))
        grid = np.linspace(0.0, 1.0, 33)
        at = curve(grid)
        nothing = [np.zeros((m.shape[1], m.shape[1])) for m in at]
        found = []
        for b in range(len(self.results.blocks)):
            µ = grid
            mean = at[b]
            for _ in range(4):
                scores = [self._alone(b, row, nothing[b]) for row in mean]
                best = int(np.argmin(scores))
                low, high = µ[max(0, best - 1)], µ[min(len(µ) - 1, best + 1)]
                µ = np.linspace(low, high, 9)
                mean = curve(µ)[b]
            scores = [self._alone(b, row, nothing[b]) for row in mean]
            found.append((float(µ[int(np.argmin(scores))]), mean[int(np.argmin(scores))]))
        fit = self.results.judge(Means([m for _, m in found], nothing, nothing), len(self.results.blocks))
        shown = ", ".join(f"{µ:.4g}" for µ, _ in found)
        whose = ", ".join(block.link or "given" for block in self.results.blocks)
        mistake = Mistake(WRONG_LINK, f"the links' probabilities are {{0}} where they should be {whose}")
        rows = uniform_rows([µ for µ, _ in found])
        means = trial.means(replace(self.base, rows=rows))
        apart = 0.0 if means is None else self.results.apart(means)
        return _ClosestMistake((mistake,), None, fit, found[0][0], len(found), apart, False, shown)

    def _alone(self, b: int, mean: np.ndarray, nothing: np.ndarray) -> float:
        alone = Fits(self.results.blocks[b : b + 1])
        return alone.judge(Means([mean], [nothing], [nothing])).distance

    def _dependent(self, trial: _SimulatorTrials) -> _ClosestMistake | None:
        """The right results, of fewer runs than there seem to be."""
        means = trial.means(self.base)
        if means is None:
            return None
        effective, dependent = [], False
        for block, spread in zip(self.results.blocks, means.spread, strict=True):
            n = float(min(cell.runs for cell in block.cells))
            found = None if block.values is None else independent_runs(block.values, vary=bool(spread.any()))
            noisy = [i for i, cell in enumerate(block.cells) if cell.quantity != CLAIMED]
            if block.values is not None and noisy:
                # noise that is the same to the last digit was drawn once
                once = len(np.unique(block.values[:, noisy], axis=0))
                if once < DIFFERENT * len(block.values):
                    found = min(once, found or np.inf)
            dependent |= found is not None
            effective.append(n if found is None else found)
        if not dependent:
            return None
        fit = self.results.judge(
            means._replace(mean=self.results.expected.mean, noise=self.results.expected.noise), runs=effective
        )
        text = "the runs are not independent of each other, and tell no more than about {0} that are"
        shown = f"{min(effective):.3g}"
        return _ClosestMistake((Mistake(DEPENDENT, text),), None, fit, min(effective), 1, 0.0, False, shown)

    def _approximate(self, trial: _SimulatorTrials) -> _ClosestMistake | None:
        if self.prediction.nature not in ("approximate", "bound"):
            return None
        text = "nothing is wrong with the simulator: the prediction is approximate, and exact numbers are as the file's"
        return trial.best((Mistake(APPROXIMATE, text),), [Variant(lambda _: self.base)])


class _SimulatorTrials:
    """Tries simulators with samples of one size, and exactly where that is asked for and can be had."""

    def __init__(self, diagnosis: _Diagnosis, runs: int, *, exactly: bool = False) -> None:
        self.diagnosis, self.exactly = diagnosis, exactly
        self.sampler = Sampler(runs, errors=diagnosis.results.errors)
        self._right: list[np.ndarray] | None = None

    def means(self, simulator: Simulator) -> Means | None:
        """What a simulator shows; None if there is no such simulator."""
        d = self.diagnosis
        try:
            with np.errstate(all="ignore"):
                if self._right is None:
                    self._right = self.sampler.shown(d.base, d.results.blocks)
                shown = self.sampler.shown(simulator, d.results.blocks)
        except (StochfuseError, np.linalg.LinAlgError):
            return None
        mean, noise, spread = [], [], []
        outright = self.exact(simulator)
        difference = d.prediction.nature == "exact"
        for b, (X, Z, expected) in enumerate(zip(shown, self._right, d.results.expected.mean, strict=True)):
            unknown = np.isnan(X).all(axis=0)
            if not np.isfinite(X[:, ~unknown]).all():
                return None
            X = np.where(unknown, Z, X)
            own, apart = covariance_of(X), covariance_of(X - Z)
            # cells of unlike sizes count alike
            scale = np.where(np.diagonal(own) > 0, np.diagonal(own), 1.0)
            closer = difference and (np.diagonal(apart) / scale).sum() <= (np.diagonal(own) / scale).sum()
            of_sample = expected + (X - Z).mean(axis=0) if closer else X.mean(axis=0)
            mean.append(np.where(unknown, np.nan, of_sample) if outright is None else outright[b])
            noise.append(np.zeros_like(own) if outright is not None else (apart if closer else own) / len(X))
            spread.append(own)
        return Means(mean, noise, spread, shown)

    def exact(self, simulator: Simulator) -> list[np.ndarray] | None:
        """What a simulator shows on average, where that is asked for and can be had."""
        if not self.exactly:
            return None
        try:
            with np.errstate(all="ignore"):
                found = exactly(simulator, self.diagnosis.results.blocks)
        except (StochfuseError, np.linalg.LinAlgError):
            return None
        return found if found is None or all(np.isfinite(m).all() for m in found) else None

    def best(
        self, mistakes: tuple[Mistake, ...], variants: Iterator[Variant] | Sequence[Variant]
    ) -> _ClosestMistake | None:
        """The variant that comes closest to the results."""
        found = [t for v in variants if (t := self._fitted(mistakes, v)) is not None]
        return min(found, key=self.diagnosis._rank) if found else None

    def _fitted(self, mistakes: tuple[Mistake, ...], variant: Variant) -> _ClosestMistake | None:
        if not variant.grid:
            means = self.means(variant.of(0.0))
            return None if means is None else self._tried(mistakes, variant, means)
        points: dict[float, Means] = {}
        for at in variant.grid:
            means = self.means(variant.of(at))
            if means is not None:
                points[at] = means
        if len(points) < 3:
            return None
        distance = {at: self.diagnosis.results.judge(means, 1).distance for at, means in points.items()}
        for _ in range(8):
            best = min(distance, key=distance.__getitem__)
            new = self._lowest(points, best)
            if min(abs(new - at) for at in points) < 1e-9:
                break
            means = self.means(variant.of(new))
            if means is None:
                break
            points[new], distance[new] = means, self.diagnosis.results.judge(means, 1).distance
            if 0 <= distance[best] - distance[new] < CLOSE:
                break
        best = min(distance, key=distance.__getitem__)
        return self._tried(mistakes, variant, points[best], best)

    def _lowest(self, points: dict[float, Means], best: float) -> float:
        """Where the cells' parabolas through three points come closest to the results, near the best of these."""
        a, b, c = sorted(sorted(points, key=lambda at: abs(at - best))[:3])
        low, high = a - (b - a) / 2 - b, c + (c - b) / 2 - b
        quartic = np.zeros(5)
        for block, W in enumerate(self.diagnosis.results.scales(points[best])):
            at_a, at_b, at_c = (points[at].mean[block] for at in (a, b, c))
            # Newton's form about b: m = m_b + s u + q u²
            left, right = (at_b - at_a) / (b - a), (at_c - at_b) / (c - b)
            q = (right - left) / (c - a)
            s = left + q * (b - a)
            r = np.array([cell.mean for cell in self.diagnosis.results.blocks[block].cells]) - at_b
            known = ~np.isnan(r)
            terms = [W[:, known] @ x[known] for x in (-q, -s, r)]
            for i, one in enumerate(terms):
                for j, other in enumerate(terms):
                    quartic[i + j] += one @ other
        roots = np.roots(np.polyder(quartic))
        inside = [low, high, *(x.real for x in roots if abs(x.imag) < 1e-9 and low < x.real < high)]
        return float(b + min(inside, key=lambda u: np.polyval(quartic, u)))

    def _tried(self, mistakes: tuple[Mistake, ...], variant: Variant, means: Means, at: float = 0.0) -> _ClosestMistake:
        d, numbers = self.diagnosis, int(bool(variant.grid))
        fit = d.results.judge(means, numbers)
        apart = d.results.apart(means) if fit.p > WORTH else 0.0
        return _ClosestMistake(mistakes, variant, fit, at, numbers, apart)


def _together(one: _ClosestMistake, other: _ClosestMistake) -> Iterator[Variant]:
    """Ways to make two mistakes at once; of two unknown numbers none."""
    first, (mistake,) = one.variant, other.mistakes
    if first is None or other.variant is None or (first.grid and other.variant.grid):
        return
    start = first.grid[0] if first.grid else 0.0
    for number, second in enumerate(mistake.variants(first.of(start))):
        if first.grid:

            def of(at: float, number: int = number) -> Simulator:
                return list(mistake.variants(first.of(at)))[number].of(0.0)

            if not second.grid:
                yield Variant(of, first.grid, first.shown)
        else:
            yield second


def _curve(
    prediction: Prediction, rows: LinkRows, blocks: Sequence[LinkMeans]
) -> Callable[[np.ndarray], list[np.ndarray]] | None:
    """What is expected of link probabilities (points,), per block (points, cells); None where it is no polynomial."""
    outcomes = prediction.outcomes
    if outcomes is None or not outcomes.polynomial or rows.common(prediction.scenario.network) is None:
        return None
    if prediction.scenario.network.agents < 2:
        return None

    def one(cell: Cell, µ: np.ndarray) -> np.ndarray:
        groups = sorted({int(prediction.group_of[a - 1]) for a in cell.agents})
        share = [sum(int(prediction.group_of[a - 1]) == g for a in cell.agents) for g in groups]
        if cell.quantity not in (CLAIMED, ERROR, SQUARED):
            return np.full(len(µ), cell.expected)
        sense = metric_of(cell.metric, prediction.scenario.model)
        states = list(sense.states)
        if cell.quantity == SQUARED:
            M = outcomes.covariance(µ, "rms")[:, cell.step - 1, groups]
            return np.average(np.trace(M[..., states, :][..., states], axis1=-2, axis2=-1), axis=1, weights=share)
        if cell.quantity == ERROR:
            b = outcomes.covariance(µ, "bias")[:, cell.step - 1, groups, states[0], 0]
            return np.average(b, axis=1, weights=share)
        if sense.linear:
            M = outcomes.covariance(µ)[:, cell.step - 1]
            return np.average(np.stack([sense.of(M[:, g]) for g in groups]), axis=0, weights=share)
        moved = replace(outcomes, links=uniform_rows(µ))
        spread = [moved.distribution(sense, cell.step, [g]) for g in groups]
        return np.average([Distribution.mean(s) for s in spread], axis=0, weights=share)

    return lambda µ: [np.stack([one(cell, µ) for cell in block.cells], axis=1) for block in blocks]


def independent_runs(values: np.ndarray, *, vary: bool = True) -> float | None:
    """Return how many independent runs tell as much as dependent ones; None where no dependence shows.

    Parameters
    ----------
    values : (runs, cells) in the order of the runs.
    vary : whether runs should differ.

    Notes
    -----
    n / (1 + 2 Σ (1 − h/n) ρ(h)) over the lags h at which the correlation ρ(h), averaged over the cells, stands out;
    runs that are all alike are one.
    """
    n = len(values)
    X = values - values.mean(axis=0)
    scale = X.std(axis=0)
    moving = scale > ROUNDING * np.maximum(np.abs(values).max(axis=0), 1e-300)
    if n < 20:
        return None
    if not moving.any():
        return 1.0 if vary else None
    X = X[:, moving] / scale[moving]
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(X, size, axis=0)) ** 2
    left = np.arange(n, 10, -1)
    ρ = np.fft.irfft(power.mean(axis=1), size)[: len(left)] / left
    # cells hang together, so that their average is taken to be as uncertain as one of them
    lags = np.flatnonzero(np.abs(ρ[1:]) > 6.0 / np.sqrt(left[1:])) + 1
    if not len(lags):
        return None
    inflation = 1.0 + 2.0 * float(((1.0 - lags / n) * ρ[lags]).sum())
    return n / max(inflation, 1.0) if inflation > 1.0 else None
