"""A filter of the numbers heard: what stands in for the optimum, with an expectation that is known for any network.

How many agents' data of step k an agent i holds right after the exchange of step k is a sum of independent draws,

    m_k(i) = Σ_j b_j        P(b_j = 1) = p_ij(k) = µ_ij(k) P(no delay) P(j measures at k)        p_ii: its own sensor

so that its distribution is known (Poisson's binomial), and these numbers are independent from step to step unless links
remember.  They say most of what makes the optimum of a large network vary.  The stand-in is a filter over the last one
to three steps alone: what is held of their data is taken for

    N_k = m_k        N_t = m_t + (n − m_t)(1 − q_i^h)        h = Σ_{t<s≤k} (m_s − 1)

(everybody heard since brings the same share of the others; q_i is such that the expected numbers give what is expected
to be held after two exchanges), each measurement for the mean one of those the agent may hear, and what was known
before for what a fixed number of agents would have made known.  None of this needs to be true: whatever it is, it is
the same function of the numbers in every run and in the expectation, a finite sum over their distributions.
Numbers beyond what hardly ever comes about are cut off, in the runs as in the sum.

The stand-in is the control variate of the optimum in `stochfuse.prediction.control`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from stochfuse.kalman.kernel import taken_in
from stochfuse.kalman.metrics import Moments
from stochfuse.scenario.network import LinkRows, possible_senders
from stochfuse.scenario.system import System

LONGEST = 3
"""Steps that are looked back."""
MOST_POINTS = 4096
"""Different numbers heard that the expectation of an agent at a step is summed over, for one state."""
CUT = 1e-6
"""Probability of the numbers that are cut off, at either end."""


class _Alike(NamedTuple):
    """Agents whose numbers are looked at alike: so many steps, and so many different numbers from a lowest one on.

    Parameters
    ----------
    agents : their places.
    window : steps that are looked at.
    low : (rows, steps, agents) lowest numbers.
    chance : (rows, steps, agents, width) probability of the numbers from there on.
    """

    agents: np.ndarray
    window: int
    low: np.ndarray
    chance: np.ndarray


class Heard:
    """The stand-in for the optimum of a system.

    Parameters
    ----------
    links : rows of link probabilities.
    """

    def __init__(self, system: System, links: LinkRows) -> None:
        self.system, n = system, system.agents
        p = _probabilities(system, links)
        self.distribution = _each(p, _distribution)
        kinds = list(system.sensor_of)
        self.J = []
        for t, now in enumerate(p):
            J = np.array([s.H[t].T @ np.linalg.solve(s.R[t], s.H[t]) for s in system.sensors])[kinds]
            self.J.append(np.einsum("rij,jab->abri", now / now.sum(axis=-1, keepdims=True).clip(1e-300), J))
        mean, left = (np.stack(_each(p, of), axis=1) for of in (lambda now: now.sum(axis=-1), _not_reached))
        others, more = np.maximum(n - mean, 1e-9), np.maximum(mean - 1.0, 1e-9)
        self.miss = np.clip(left / others, 1e-9, 1.0) ** (1.0 / more)
        self.known = self._known(n - others * self.miss ** (2.0 * more))
        self.alike = list(self._gathered(1 if links.bursts is not None else LONGEST))

    def of(self, heard: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Covariances (rows, runs, steps, agents, d, d), and what is left of a known initial error (…, d, 1).

        Parameters
        ----------
        heard : (rows, runs, steps, agents) numbers m.
        """
        P, x = self._room(heard.shape)
        for k, some, since in self._parts():
            m = heard[:, :, since : k + 1, some.agents].transpose(2, 0, 3, 1).astype(float)
            if since < k:
                low = some.low[since : k + 1, ..., None]
                m = np.clip(m, low, low + some.chance.shape[-1] - 1)
            now, error = self._filtered(list(m), since, some.agents)
            P[:, :, k, some.agents] = now.transpose(2, 4, 3, 0, 1)
            if x is not None and error is not None:
                x[..., 0][:, :, k, some.agents] = error.transpose(1, 3, 2, 0)
        return P, x

    def expected(self) -> Moments:
        """Return its expected moments, (rows, steps, agents, …)."""
        rows, n = self.miss.shape[0], self.system.agents
        P, x = self._room((rows, self.system.steps, n))
        square = None if x is None else np.empty_like(P)
        for k, some, since in self._parts():
            steps = range(since, k + 1)
            if since == k:
                m, chances = [np.arange(n + 1.0)], [self.distribution[k][:, some.agents]]
            else:
                width = np.arange(some.chance.shape[-1])
                chances = [some.chance[t] for t in steps]
                m = [_along(some.low[t][..., None] + width, t - since, len(steps)) for t in steps]
            chance = np.ones(())
            for place, each in enumerate(chances):
                chance = chance * _along(each, place, len(steps))
            now, error = self._filtered(m, since, some.agents)
            over = tuple(range(-len(steps), 0))
            P[:, k, some.agents] = (now * chance).sum(axis=over).transpose(2, 3, 0, 1)
            if x is not None and square is not None and error is not None:
                x[..., 0][:, k, some.agents] = (error * chance).sum(axis=over).transpose(1, 2, 0)
                now = now + error[:, None] * error[None]
                square[:, k, some.agents] = (now * chance).sum(axis=over).transpose(2, 3, 0, 1)
        return Moments.of_optimum(P, x) if square is None else Moments(P, P, x, square)

    def _room(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray | None]:
        d = self.system.dimension
        return np.empty((*shape, d, d)), None if self.system.error is None else np.empty((*shape, d, 1))

    def _parts(self) -> Iterator[tuple[int, _Alike, int]]:
        """Every step, agents that are looked at alike, and the first step that is looked at."""
        for k in range(self.system.steps):
            for some in self.alike:
                yield k, some, max(0, k + 1 - some.window)

    def _gathered(self, longest: int) -> Iterator[_Alike]:
        """Agents by how far is looked back, as far as there are few enough numbers."""
        n, most = self.system.agents, MOST_POINTS // self.system.dimension**2
        ends = _each(
            self.distribution, lambda f: np.stack([(f.cumsum(axis=-1) <= c).sum(axis=-1) for c in (CUT, 1 - CUT)])
        )
        low, high = np.stack(ends, axis=1)  # (steps, rows, agents)
        width = np.minimum(n + 1, (high - low).max(axis=(0, 1)) // 4 * 4 + 4)
        windows = np.ones(n, dtype=int)
        for window in range(2, longest + 1):
            windows[width**window <= most] = window
        width[windows == 1] = 1
        for window, w in np.unique(np.stack([windows, width]), axis=1).T.tolist():
            agents = np.flatnonzero((windows == window) & (width == w))
            start = np.minimum(low[..., agents], n + 1 - w)
            place = start[..., None] + np.arange(w)
            chance = np.empty(place.shape)
            for t, f in enumerate(self.distribution if window > 1 else ()):
                total = f[:, agents].cumsum(axis=-1)
                total = np.take_along_axis(total, place[t], axis=-1)
                total[..., -1] = 1.0
                chance[t] = np.diff(total, axis=-1, prepend=0.0)
            yield _Alike(agents, window, start, chance)

    def _known(self, held: np.ndarray) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """What is known before the data of every step, (d, d, rows, agents), by so many agents' of each step before."""
        P, x = self._begun(held[:, 0])
        found = [(P, x)]
        for t in range(1, self.system.steps):
            found.append(self._predicted(P, x, t))
            P, x = taken_in(found[t][0], self.J[t] * held[:, t], found[t][1])
        return found

    def _begun(self, held: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """First estimates, of so many agents together."""
        P0, error = self.system.P0, self.system.error
        number = np.ones_like(held) if self.system.shared else np.maximum(held, 1.0)
        trailing = (1,) * held.ndim
        x = None if error is None else np.broadcast_to(error.reshape(-1, *trailing), (len(P0), *held.shape))
        return P0.reshape(*P0.shape, *trailing) / number, x

    def _predicted(self, P: np.ndarray, x: np.ndarray | None, t: int) -> tuple[np.ndarray, np.ndarray | None]:
        F, Q = self.system.model.F[t], self.system.model.Q[t]
        prior = (np.kron(F, F) @ P.reshape(F.size, -1)).reshape(P.shape) + Q.reshape(*Q.shape, *(1,) * (P.ndim - 2))
        return prior, None if x is None else np.tensordot(F, x, axes=1)

    def _filtered(
        self, m: Sequence[np.ndarray], since: int, agents: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Filter of some agents along the numbers of the last steps, (rows, agents, …) each."""
        last = since + len(m) - 1
        rest = (1,) * max(each.ndim - 2 for each in m) if m[0].ndim > 1 else (1,)
        shape = np.broadcast_shapes((*self.miss[:, last, agents].shape, *rest), *(each.shape for each in m))

        def of(M: np.ndarray) -> np.ndarray:
            return M[..., agents].reshape(*M.shape[:-1], len(agents), *rest)

        miss, P, x = of(self.miss[:, last]), *self.known[since]
        P, x = of(P), None if x is None else of(x)
        for place, t in enumerate(range(since, last + 1)):
            held = np.broadcast_to(m[place], shape)
            if place < len(m) - 1:
                later = sum(np.maximum(each - 1.0, 0.0) for each in m[place + 1 :])
                held = held + (self.system.agents - held) * (1.0 - miss**later)
            if t == 0:
                P, x = self._begun(held)
                continue
            if t > since:
                P, x = self._predicted(P, x, t)
            P, x = taken_in(P, of(self.J[t]) * held, x)
        return P, x


def _along(each: np.ndarray, place: int, number: int) -> np.ndarray:
    """An array (rows, agents, width) whose last axis becomes one of several."""
    shape = [1] * number
    shape[place] = each.shape[-1]
    return each.reshape(*each.shape[:-1], *shape)


def _each(all_of: Sequence[np.ndarray], function: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """What a function makes of arrays, of equal ones once."""
    found = {id(each): each for each in all_of}
    made = {key: function(each) for key, each in found.items()}
    return [made[id(each)] for each in all_of]


def _probabilities(system: System, links: LinkRows) -> list[np.ndarray]:
    """Probability that an agent holds another's data of a step after its exchange, (rows, agents, agents) of each."""
    network, n, rows, detects = system.network, system.agents, len(links.link), system.detects
    senders = np.array(possible_senders(network.architecture, n))[None]
    at_once = np.array([[network.delay_of(i, j)[0] if i != j else 1.0 for j in range(n)] for i in range(n)])
    found: list[np.ndarray] = []
    for step in range(1, system.steps + 1):
        if found and not links.varies and (detects is None or (detects[step - 1] == detects[step - 2]).all()):
            found.append(found[-1])
            continue
        p = np.zeros((rows, n, n))
        np.put_along_axis(
            p, np.broadcast_to(senders, (rows, *senders.shape[1:])), links.matrices(network, step), axis=-1
        )
        p *= at_once
        p[:, range(n), range(n)] = 1.0
        if detects is not None:
            p *= detects[step - 1][list(system.sensor_of)]
        found.append(p)
    return found


def _distribution(p: np.ndarray) -> np.ndarray:
    """Distribution of a sum of independent draws, (…, draws + 1), of their probabilities (…, draws)."""
    out = np.zeros((*p.shape[:-1], p.shape[-1] + 1))
    out[..., 0] = 1.0
    for j in range(p.shape[-1]):
        one = p[..., j, None]
        more = out[..., :-1] * one
        out *= 1.0 - one
        out[..., 1:] += more
    return out


def _not_reached(p: np.ndarray) -> np.ndarray:
    """How many agents' data are expected not to have come in two exchanges, about, (rows, agents)."""
    M = p.copy()
    M[:, range(M.shape[1]), range(M.shape[1])] = 0.0
    left = (1.0 - M) ** 2 * np.exp(-(M @ M))
    return left.sum(axis=-1) - np.diagonal(left, axis1=-2, axis2=-1)
