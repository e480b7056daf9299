"""The simplified stochastic formulation, thesis (50)–(54).

For like agents that are heard with equal probability, m of the N = n − 1 possible messages arrive with
β(m) = C(N, m) µ^m (1−µ)^(N−m), (50), and

    (54)  P(k) = Σ β(m) P_m,    P_m = [(m+1) P⁻¹(k|k) − m P⁻¹(k|k−1)]⁻¹
    (53)  x̂(k) = Σ β(m) P_m [(m+1) P⁻¹(k|k) x̂(k|k) − m P⁻¹(k|k−1) x̂(k|k−1)]

where P(k|k−1) is predicted from the *averaged* P(k−1).  Since P⁻¹(k|k) = P⁻¹(k|k−1) + HᵀR⁻¹H,

    P_m = update(P(k|k−1), R/(m+1)):

m arrivals make one Kalman update with m + 1 measurements.  `outcome` is that form, `outcome_as_printed` the literal
one; the symbolic tests prove them equal.  At step 1 independent initial estimates share nothing, and P_m = P(k0)/(m+1);
a shared initial estimate stays what it is.

Departures from the source
--------------------------
* Erratum 1: (53) prints P(k) in front of the sum; by (48) P_m belongs inside.  As printed the estimate is biased by
  E[P_m] E[P_m⁻¹] ≥ 1.  `stochfuse.prediction.states` evaluates both.
* Erratum 2: (52) counts m − 1 common terms because its m counts all sets; (53)/(54) count received sets.
* Unequal links µ_ij(k): the number of arrivals is Poisson-binomial.  Unlike agents: agent i averages over the sets S of
  senders, P_S⁻¹ = P_i⁻¹(k|k−1) + J_i + Σ_{j∈S} J_j, summed here by how many of each kind of sensor arrive.
* Sensors that may miss: measurements arrive, not messages, so that µ_ij becomes µ_ij p_j and the agent's own is one
  more that arrives with p_i; no measurement at all leaves the prediction.
* Cyclic and masked networks: the same recursion with the true number of possible senders, an approximation outside the
  derivation (`departures` says so).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import prod
from typing import Any, NamedTuple

import numpy as np

from stochfuse.engines.mean_field import Case, UnlikeCase, run, run_like
from stochfuse.engines.precision import definite, ill_noise, lost, rounding, told
from stochfuse.errors import UsageError
from stochfuse.kalman.algebra import NUMPY, Algebra, inverse
from stochfuse.kalman.arrivals import Arrivals, Counts, like_senders, poisson_binomial
from stochfuse.kalman.checks import first_fault
from stochfuse.kalman.kernel import Estimate, from_information, to_information, update, update_information
from stochfuse.kalman.metrics import Moments
from stochfuse.kalman.packed import noise_factor, sound, triangle
from stochfuse.prediction.method import Averaged, Settings, joined
from stochfuse.scenario.capabilities import require
from stochfuse.scenario.network import LinkRows, number_of_senders, possible_senders
from stochfuse.scenario.registry import BROADCAST_PRIOR, SIMPLIFIED
from stochfuse.scenario.system import Items, Noises, System

DOUBTFUL = 1e-10
"""Smallest pivot of R, relative to its variance, below which it takes a library's word that there is a factor."""
MOST_WEIGHTS = 1 << 28
"""Probabilities of sets of senders (counted by kind of sensor) beyond which unlike agents are refused: 2 GB of them."""


def outcome(prior: Estimate, H: Any, R: Any, m: int, z: Any = None, *, algebra: Algebra = NUMPY) -> Estimate:
    """P_m and x̂_m as one update with m + 1 measurements: the identity behind (53)/(54), in any algebra."""
    return update(prior, H, R / (m + 1), z, algebra=algebra)


def outcome_by_information(prior: Estimate, H: Any, R: Any, m: int, *, algebra: Algebra = NUMPY) -> Estimate:
    """P_m in information form, [P⁻¹(k|k−1) + (m+1) HᵀR⁻¹H]⁻¹, the shortest for symbols; needs an invertible prior."""
    information = update_information(to_information(prior, algebra=algebra), H, R / (m + 1), algebra=algebra)
    return from_information(information, algebra=algebra)


def outcome_as_printed(prior: Estimate, H: Any, R: Any, m: int, z: Any = None, *, algebra: Algebra = NUMPY) -> Estimate:
    """P_m and x̂_m as (53)/(54) print them; the prior must be invertible."""
    before = to_information(prior, algebra=algebra)
    local = to_information(update(prior, H, R, z, algebra=algebra), algebra=algebra)
    P = algebra.symmetric(inverse((m + 1) * local.Y - m * before.Y, algebra))
    if prior.x is None:
        return Estimate(None, P)
    return Estimate(P @ ((m + 1) * local.y - m * before.y), P)


def average(outcomes: Sequence[Estimate], weights: Sequence[Any]) -> Estimate:
    """Σ β(m)·(x̂_m, P_m): the expectation in (53)/(54), with P_m inside the sum."""
    P = _weighted([o.P for o in outcomes], weights)
    return Estimate(None if outcomes[0].x is None else _weighted([o.x for o in outcomes], weights), P)


def _weighted(matrices: Sequence[Any], weights: Sequence[Any]) -> Any:
    # matrix first: an exact scalar does not know how to multiply an array, an array knows both ways
    terms = [A * w for A, w in zip(matrices, weights, strict=True)]
    return sum(terms[1:], terms[0])


class LikeAgents(NamedTuple):
    """Agents whose covariances are equal, and how the engine carries them.

    Parameters
    ----------
    agents : numbers of the agents, from 0, per column of the group.
    case : `Case` for like agents, `UnlikeCase` for unlike ones.
    """

    agents: tuple[tuple[int, ...], ...]
    case: Case | UnlikeCase

    @property
    def columns(self) -> int:
        """Number of distinct receivers."""
        return len(self.agents)


class Covariances(NamedTuple):
    """Averaged posterior covariances.

    Parameters
    ----------
    P : (items, steps, groups, d, d); an item with a fault may have entries that are not finite.
    group_of : index into the groups for every agent, shape (agents,).
    forms : which numeric forms were used.
    faults : per item whose result is no covariance, the first step and why.
    cancelled : (items,) whether the measurement-space form cancelled, so that the square-root form was needed.
    """

    P: np.ndarray
    group_of: np.ndarray
    forms: tuple[str, ...]
    faults: dict[int, str]
    cancelled: np.ndarray


def averaged(system: System, items: Items, how: Settings = Settings(), errors: bool = False) -> Averaged:  # noqa: B008
    """Evaluate (54) as a method, see `Averaged`; errors are added by `stochfuse.prediction.states.with_errors`.

    Raises
    ------
    UsageError
        As `covariances`.
    """
    if not items.noises.common and not _one_case(system, items.links):
        return joined([(members, averaged(alone, some)) for members, alone, some in items.by_noises(system)])
    found = covariances(system, items)
    said, faults = departures(system, items.links), dict(found.faults)
    reach = np.zeros(len(items))
    if items.noises.common and not faults and ("square-root" in found.forms or ill_noise(system)):
        reach = reach_of_rounding(system, items)
        said += [told(float(reach[lost(reach)].max()))] if lost(reach).any() else []
    elif not items.noises.common and found.cancelled.any():
        some = np.flatnonzero(found.cancelled)
        reach[some] = reach_of_rounding(system, items.take(some))
        faults = {int(item): told(float(reach[item])) for item in some if lost(reach[item])} | faults
    return Averaged(
        moments=Moments(found.P),
        group_of=found.group_of,
        natures=np.full(len(items), "approximate"),
        estimator=BROADCAST_PRIOR,
        rounding=reach,
        faults=faults,
        notes=tuple(said),
        forms=found.forms,
    )


def covariances(system: System, items: Items) -> Covariances:
    """Evaluate (54) for every item and every step.

    Items with noises of their own are like agents with equal links: of others, give those of one set of noises.

    Raises
    ------
    UsageError
        If messages are delayed, unlike agents make too many outcomes, or agents do not track one state with independent
        noises.
    """
    steps, links = system.steps, len(items)
    parts, forms, all_groups = [], set(), groups(system, items)
    why: dict[int, str] = {}
    needed_root = np.zeros(links, dtype=bool)
    for group in all_groups:
        if isinstance(group.case, Case):
            usable, singular = _factorable(group.case)
            P, cancelled, unsound = run_like(usable, steps)
            forms |= forms_used(cancelled)
            needed_root |= cancelled.reshape(links, -1).any(axis=1)
        else:
            singular, unsound, P = {}, None, np.empty((steps, *system.P0.shape, group.case.items))
            with np.errstate(all="ignore"):
                run(group.case, steps, P)
            forms.add("outcomes")
        for item, fault in sorted((faults(P, unsound) | singular).items()):
            why.setdefault(item // group.columns, fault)
        d = P.shape[1]
        parts.append(P.reshape(steps, d, d, links, group.columns).transpose(3, 0, 4, 1, 2))
    P = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)
    return Covariances(P, index_of_groups(all_groups, system.agents), tuple(sorted(forms)), why, needed_root)


def _factorable(case: Case) -> tuple[Case, dict[int, str]]:
    """Return a case of which every item's R has a Cholesky factor, and why those that had none have no answer."""
    R = case.noises.R
    if R is None:
        return case, {}
    left = noise_factor(R)[1]
    usable = left > 0
    doubtful = np.flatnonzero(usable & (left < DOUBTFUL))
    usable[doubtful] = definite(R[doubtful])
    if usable.all():
        return case, {}
    why = "R: expected a positive definite matrix, got one that is singular to rounding"
    fine = np.where(usable[:, None, None], R, np.eye(R.shape[-1]))
    return replace(case, noises=case.noises._replace(R=fine)), dict.fromkeys(np.flatnonzero(~usable).tolist(), why)


def _one_case(system: System, links: LinkRows) -> bool:
    """Whether all agents are like ones with equal links, which take noises of the items' own."""
    return len(system.sensors) == 1 and links.uniform


def forms_used(cancelled: np.ndarray) -> set[str]:
    """Return the numeric forms of like agents, from whether each item needed the square-root form."""
    used = {"square-root"} if cancelled.any() else set()
    return used | ({"measurement-space"} if not cancelled.all() else set())


def faults(P: np.ndarray, suspects: np.ndarray | None = None) -> dict[int, str]:
    """Why covariances (steps, d, d, items) are none, per item where one is not: the first step and what is wrong.

    Parameters
    ----------
    suspects : (items,) which items to look at; default: those that a cheap check is not satisfied with.
    """
    if suspects is None:
        # what is not finite stays so; what an update takes too much of shows in a variance, or at the last step
        d = P.shape[1]
        suspects = ~(sound(P[-1][triangle(d)[:2]], d) & (np.diagonal(P, axis1=1, axis2=2) >= 0).all(axis=(0, 2)))
    found: dict[int, str] = {}
    for item in np.flatnonzero(suspects):
        first = first_fault(P[..., item])
        if first is not None:
            step, fault = first
            lost = f"the covariance at step {step} is not finite: it grows beyond floating point"
            fine_at = np.isfinite(P[step - 1, ..., item]).all()
            found[int(item)] = f"expected a covariance at step {step}, got {fault}" if fine_at else lost
    return found


def index_of_groups(all_groups: Sequence[LikeAgents], agents: int) -> np.ndarray:
    """Index of every agent's column among the columns of all groups, shape (agents,)."""
    index = np.zeros(agents, dtype=int)
    for column, members in enumerate(members for group in all_groups for members in group.agents):
        index[list(members)] = column
    return index


def reach_of_rounding(system: System, items: Items) -> np.ndarray:
    """Relative error that rounding may cause in the covariance of like agents at some step, for every item.

    At three or four times the cost of the square-root form; see `stochfuse.engines.precision`.  Zeros for unlike
    agents, for whom it is not known.
    """
    reach = np.zeros(len(items))
    for group in groups(system, items):
        if isinstance(group.case, Case):
            of_items = rounding(group.case, run_like(group.case, system.steps)[0])
            reach = np.maximum(reach, of_items.reshape(len(items), -1).max(axis=1))
    return reach


def departures(system: System, rows: LinkRows) -> list[str]:
    """Return what of a scenario lies outside the derivation of (54), one sentence each."""
    network = system.network
    notes = []
    if network.architecture == "cyclic" and network.agents > 2:
        notes.append(
            "(54) is derived for ad hoc and broadcast networks; on a cyclic one it is an approximation outside its "
            "derivation, evaluated with the one possible sender of each agent"
        )
    if not rows.uniform:
        steps = range(1, network.steps + 1 if rows.varies else 2)
        if any(((m := rows.matrices(network, k)) == 0).any() and (m > 0).any() for k in steps):
            notes.append(
                "some links have probability 0: on a masked network (54) is an approximation outside its derivation, "
                "evaluated with the possible senders of each agent"
            )
    if system.agents > 1 and (len(set(system.sensor_of)) > 1 or not rows.uniform):
        notes.append(
            "agents or links differ: (54) lets an agent's own prior stand for the others', so that only links to it "
            "count, and may be tens of per cent off; --method general or monte-carlo tells"
        )
    return notes


def groups(system: System, items: Items) -> list[LikeAgents]:
    """Return the groups of agents that (54) has to be evaluated for."""
    network, rows = system.network, items.links
    require(system, rows, BROADCAST_PRIOR, SIMPLIFIED)
    steps = range(1, network.steps + 1)
    shared = system.shared
    if _one_case(system, rows):
        return [LikeAgents((tuple(range(network.agents)),), like_case(system, rows, items.noises))]
    kinds, senders_of = np.asarray(system.sensor_of), measuring(system)
    per_step = _per_step(system, rows, lambda step: measured(system, rows, step))
    matrices = dict(zip(steps, per_step, strict=True))
    return [
        _group(system, shared, np.flatnonzero(kinds == own), own, kinds[senders_of], matrices)
        for own in range(len(system.sensors))
    ]


def measuring(system: System) -> np.ndarray:
    """Whose measurement may arrive at each agent, (agents, senders): its own among them where sensors may miss."""
    senders_of = possible_senders(system.network.architecture, system.agents)
    if system.detects is None:
        return senders_of
    return np.concatenate([senders_of, np.arange(system.agents)[:, None]], axis=1)


def measured(system: System, rows: LinkRows, step: int) -> np.ndarray:
    """How likely each of these measurements arrives at a step, (rows, agents, senders)."""
    heard = rows.matrices(system.network, step)
    if system.detects is None:
        return heard
    p = system.detects[step - 1, list(system.sensor_of)]
    here = np.concatenate([heard, np.ones((*heard.shape[:2], 1))], axis=2)
    return here * p[measuring(system)]


def like_case(system: System, rows: LinkRows, noises: Noises) -> Case:
    """Like agents with equally likely links, and the noises of the items' own where there are any."""
    network = system.network
    senders = number_of_senders(network.architecture, network.agents)

    def of_step(step: int) -> Arrivals:
        detection = 1.0 if system.detects is None else float(system.detects[step - 1, 0])
        return like_senders(senders, rows.at_step(step), detection)

    arrivals = _per_step(system, rows, of_step)
    shared = system.shared
    return Case(system.model, system.sensors[0], system.P0, shared, arrivals, len(rows.link), noises)


def _group(
    system: System,
    shared: bool,
    agents: np.ndarray,
    own: int,
    sender_kinds: np.ndarray,
    matrices: dict[int, np.ndarray],
) -> LikeAgents:
    """Agents with one kind of sensor, those that hear others with the same probabilities taken together."""
    kinds_here = sender_kinds[agents]
    order = np.argsort(kinds_here, axis=1, kind="stable")
    kinds_here = np.take_along_axis(kinds_here, order, axis=1)
    by_step, seen = [], {}
    for matrix in matrices.values():
        if id(matrix) not in seen:
            heard = np.take_along_axis(matrix[:, agents], order[None], axis=2)
            for kind in np.unique(kinds_here):
                # like senders are interchangeable: sort their probabilities, so that equal receivers look equal
                heard = _sort_within(heard, kinds_here == kind)
            seen[id(matrix)] = heard
        by_step.append(seen[id(matrix)])
    signature = np.concatenate(
        [kinds_here, *(h.transpose(1, 0, 2).reshape(len(agents), -1) for h in seen.values())], axis=1
    )
    _, first, column_of = np.unique(signature, axis=0, return_index=True, return_inverse=True)
    members = tuple(tuple(agents[column_of.ravel() == c].tolist()) for c in range(len(first)))
    if len(system.sensors) == 1:
        counts = Counts if system.detects is None else Counts.of_measurements
        tables = {id(h): counts(_items(poisson_binomial(np.moveaxis(h[:, first], -1, 0)))) for h in by_step}
        arrivals = [tables[id(h)] for h in by_step]
        items = by_step[0].shape[0] * len(first)
        return LikeAgents(members, Case(system.model, system.sensors[0], system.P0, shared, arrivals, items))
    once = {id(h): h[:, first] for h in by_step}
    return LikeAgents(members, _outcomes(system, shared, own, kinds_here[first], [once[id(h)] for h in by_step]))


def _sort_within(heard: np.ndarray, mask: np.ndarray) -> np.ndarray:
    filled = np.where(mask, heard, np.inf)
    ranks = np.sort(filled, axis=-1)
    places = np.cumsum(mask, axis=-1) - 1
    return np.where(
        mask, np.take_along_axis(ranks, np.broadcast_to(np.maximum(places, 0), heard.shape), axis=-1), heard
    )


def _items(table: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(table.reshape(len(table), -1))


def _outcomes(system: System, shared: bool, own: int, sender_kinds: np.ndarray, heard: list[np.ndarray]) -> UnlikeCase:
    """Every count of arrivals per kind of sensor; receivers of one kind may hear different numbers of each."""
    kinds = range(len(system.sensors))
    most = [int((sender_kinds == kind).sum(axis=1).max()) if sender_kinds.size else 0 for kind in kinds]
    number, links = prod(n + 1 for n in most), sum(h[..., 0].size for h in {id(h): h for h in heard}.values())
    if number * links * len(kinds) > MOST_WEIGHTS:
        raise UsageError(
            f"method simplified: unlike agents make {number} sets of senders to average over, of {links * len(kinds)} "
            f"probabilities each (at most {MOST_WEIGHTS} in all are kept); give fewer kinds of sensors or rows, or "
            "--method monte-carlo, which draws them, or --quantity optimal"
        )
    counts = np.indices([n + 1 for n in most], dtype=np.min_scalar_type(max(most) + 1)).reshape(len(most), -1).T
    weights, seen = [], {}
    for h in heard:
        if id(h) not in seen:
            seen[id(h)] = _outcome_weights(h, sender_kinds, counts, kinds)
        weights.append(seen[id(h)])
    if system.detects is None:
        counts[:, own] += 1
    return UnlikeCase(system.model, system.sensors, system.P0, shared, counts, weights)


def _outcome_weights(heard: np.ndarray, sender_kinds: np.ndarray, counts: np.ndarray, kinds: range) -> np.ndarray:
    weights = np.ones((len(counts), *heard.shape[:2]))
    for kind in kinds:
        # a link to a sender of another kind cannot deliver this kind: probability 0 leaves its count as it is
        pmf = poisson_binomial(np.moveaxis(np.where(sender_kinds == kind, heard, 0.0), -1, 0))
        weights *= pmf[counts[:, kind]]
    return _items(weights)


def _per_step(system: System, rows: LinkRows, make: Any) -> list[Any]:
    """One object per step, and the same object at steps where neither links nor detections differ."""
    steps, detects = range(1, system.steps + 1), system.detects
    if rows.varies:
        return [make(step) for step in steps]
    made: dict[bytes, Any] = {}
    alike = [b"" if detects is None else detects[step - 1].tobytes() for step in steps]
    for step, key in zip(steps, alike, strict=True):
        if key not in made:
            made[key] = make(step)
    return [made[key] for key in alike]
