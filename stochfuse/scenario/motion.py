"""Models by name: how a target moves, from a kind, a time step and one noise; and the path it is meant to take.

With T the time since the step before (which may differ from step to step), per axis, and the axes independent:

    random walk             state x            F = 1
    constant velocity       x, vx              F = [1 T; 0 1]
    constant acceleration   x, vx, ax          F = [1 T T²/2; 0 1 T; 0 0 1]

    continuous: white noise of density q drives the last state's derivative
        n states, i, j = 1 … n:  Q_ij = q T^(2n+1−i−j) / ((2n+1−i−j) (n−i)! (n−j)!)
        n = 2: Q = q [T³/3 T²/2; T²/2 T]       q in m²/s, m²/s³, m²/s⁵
    piecewise: one draw for all of a step, of standard deviation σ:  Q = σ² Γ Γᵀ, singular where n > 1
        random walk             Γ = T              σ a velocity (m/s)
        constant velocity       Γ = (T²/2, T)      σ an acceleration (m/s²)
        constant acceleration   Γ = (T²/2, T, 1)   σ what the acceleration grows by (m/s²)

Coordinated turn, x, vx, y, vy in the plane, at a known turn rate ω (rad/s, positive from x to y), θ = ωT:

    F = [1  sin θ/ω  0  −(1−cos θ)/ω;  0  cos θ  0  −sin θ;  0  (1−cos θ)/ω  1  sin θ/ω;  0  sin θ  0  cos θ]
    continuous: x and x  2q(θ − sin θ)/ω³;  x and vx  q(1 − cos θ)/ω²;  x and vy  q(θ − sin θ)/ω²;
                vx and vx  qT;  y likewise, y and vx the negative of x and vy
    piecewise: Γ of constant velocity per axis

All in forms that do not cancel, so that ω = 0 is constant velocity.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, (6.2.2) and (6.2.3) for
the continuous, (6.3.2) and (6.3.3) for the piecewise noises, 11.7.1 for the turn.  Departures: the states of a turn are
ordered axis by axis as all are here; its turn rate is known, not a state, so that the model is linear; its continuous
noise, an acceleration that is white in the frame at rest, is integrated along the turn (Li and Jilkov, Survey of
maneuvering target tracking, part I, section V).

The nominal path x*(k), which sensors that are not linear are linearised about: x*(1) from [model.nominal], then
x*(k) = F x*(k−1) + B u; or its places are given per step, and its velocities say how fast it came from the one before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import factorial
from typing import Any, NamedTuple

import numpy as np

from stochfuse.kalman.checks import LARGEST, shown
from stochfuse.scenario.checker import Checker
from stochfuse.scenario.model import Model, over_steps

ORDERS = {"random-walk": 1, "constant-velocity": 2, "constant-acceleration": 3, "coordinated-turn": 2}
"""States of each axis, by kind of model."""
TURN = "coordinated-turn"
NOISES = ("continuous", "piecewise")
AXES = "xyz"
BEFORE = ("", "v", "a")
"""What stands before an axis' name in the names of a place, a velocity and an acceleration."""
UNITS = ("m", "m/s", "m/s²")
KEYS = ("axes", "noise", "noise_kind", "turn_rate")
"""Keys of [model] that say nothing without a kind."""
SHORTEST, LONGEST, LOUDEST = 1e-12, 1e9, 1e30
"""Shortest and longest time step in s, and largest noise: what is made of them stays below `LARGEST`."""


class Motion(NamedTuple):
    """A model made from its name.

    Parameters
    ----------
    F, Q : (d, d), or (steps, d, d) where time steps or turn rates differ.
    states, units : names and units, axis by axis.
    """

    F: np.ndarray
    Q: np.ndarray
    states: tuple[str, ...]
    units: tuple[str, ...]


class Layout(NamedTuple):
    """Which states are what, by their indices, one for each axis; empty where the model has no such states."""

    place: tuple[int, ...]
    velocity: tuple[int, ...] = ()
    acceleration: tuple[int, ...] = ()

    @property
    def axes(self) -> int:
        """Number of axes."""
        return len(self.place)


class Course(NamedTuple):
    """What sensors look at.

    Parameters
    ----------
    layout : which states are places and velocities.
    step : () or (steps,) seconds since the step before.
    path : (steps, d) nominal states, or None where none is given.
    """

    layout: Layout
    step: np.ndarray
    path: np.ndarray | None


def transition(kind: str, T: Any, axes: int = 2, turn_rate: Any = 0.0) -> np.ndarray:
    """State transition F (..., d, d) of a kind of model.

    Parameters
    ----------
    kind : one of `ORDERS`.
    T : (...) seconds.
    axes : number of axes; a turn has two.
    turn_rate : (...) rad/s, of a turn.
    """
    T = np.asarray(T, dtype=float)
    if kind == TURN:
        return _turned(T, np.asarray(turn_rate, dtype=float))
    n = ORDERS[kind]
    block = np.zeros((*T.shape, n, n))
    for i in range(n):
        for j in range(i, n):
            block[..., i, j] = T ** (j - i) / factorial(j - i)
    return _every_axis(block, axes)


def process_noise(
    kind: str, T: Any, noise: float, noise_kind: str = "continuous", axes: int = 2, turn_rate: Any = 0.0
) -> np.ndarray:
    """Process noise covariance Q (..., d, d) of a kind of model.

    Parameters
    ----------
    kind, T, axes, turn_rate : as `transition` takes them.
    noise : density q of the continuous noise, standard deviation σ of the piecewise one.
    noise_kind : "continuous" or "piecewise".
    """
    T = np.asarray(T, dtype=float)
    if noise_kind == "piecewise":
        gain = _gain(kind, T)
        return noise**2 * _every_axis(gain[..., :, None] * gain[..., None, :], axes)
    if kind == TURN:
        return noise * _turning_noise(T, np.asarray(turn_rate, dtype=float))
    n = ORDERS[kind]
    block = np.zeros((*T.shape, n, n))
    for i in range(n):
        for j in range(n):
            power = 2 * n - 1 - i - j
            block[..., i, j] = T**power / (power * factorial(n - 1 - i) * factorial(n - 1 - j))
    return noise * _every_axis(block, axes)


def _gain(kind: str, T: np.ndarray) -> np.ndarray:
    """Γ of the piecewise noise, (..., n)."""
    one = np.ones_like(T)
    return np.stack([T] if ORDERS[kind] == 1 else [0.5 * T**2, T, one][: ORDERS[kind]], axis=-1)


def _every_axis(block: np.ndarray, axes: int) -> np.ndarray:
    return np.kron(np.eye(axes), block)


def _turned(T: np.ndarray, rate: np.ndarray) -> np.ndarray:
    angle = rate * T
    along, across = T * _sine(angle), T * _versine(angle)
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = [
        [one, along, zero, -across],
        [zero, cosine, zero, -sine],
        [zero, across, one, along],
        [zero, sine, zero, cosine],
    ]
    return _matrix(rows)


def _turning_noise(T: np.ndarray, rate: np.ndarray) -> np.ndarray:
    angle = rate * T
    place = 2.0 * T**3 * _rest(angle)
    both = 0.5 * T**2 * _sine(0.5 * angle) ** 2
    turned = T**2 * angle * _rest(angle)
    T, zero = np.broadcast_to(T, angle.shape), np.zeros_like(angle)
    rows = [
        [place, both, zero, turned],
        [both, T, -turned, zero],
        [zero, -turned, place, both],
        [turned, zero, both, T],
    ]
    return _matrix(rows)


def _matrix(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


def _sine(angle: np.ndarray) -> np.ndarray:
    """Return sin θ / θ."""
    return np.sinc(angle / np.pi)


def _versine(angle: np.ndarray) -> np.ndarray:
    """(1 − cos θ) / θ."""
    return 0.5 * angle * _sine(0.5 * angle) ** 2


def _rest(angle: np.ndarray) -> np.ndarray:
    """(θ − sin θ) / θ³, by its series where the difference would cancel."""
    series = sum((-1) ** k * angle ** (2 * k) / factorial(2 * k + 3) for k in range(12))
    safe = np.where(np.abs(angle) > 1.0, angle, 1.0)
    return np.where(np.abs(angle) > 1.0, (safe - np.sin(safe)) / safe**3, series)


def read_motion(check: Checker, table: Mapping[str, Any], steps: int) -> Motion | None:
    """Read a [model] with a kind: F, Q, and what the states are called.

    Returns
    -------
    Motion or None
        None where something is wrong, which the checker has noted.
    """
    kind = check.choice("model.kind", table.get("kind"), tuple(ORDERS))
    check.absent("model", table, ("F", "Q", "G"), "nothing, since model.kind gives F and Q")
    axes = _axes(check, kind, table.get("axes", 2))
    T = read_step(check, table, steps)
    noise_kind = check.choice("model.noise_kind", table.get("noise_kind", NOISES[0]), NOISES)
    noise = _noise(check, table.get("noise"))
    rate = _turn_rate(check, kind, table.get("turn_rate"), steps)
    if kind is None or axes is None or T is None or noise_kind is None or noise is None or rate is None:
        return None
    T, rate = _constant(T), _constant(rate)
    orders = range(ORDERS[kind])
    F, Q = transition(kind, T, axes, rate), process_noise(kind, T, noise, noise_kind, axes, rate)
    for M in (F, Q):
        M.setflags(write=False)
    return Motion(
        F=F,
        Q=Q,
        states=tuple(BEFORE[order] + axis for axis in AXES[:axes] for order in orders),
        units=tuple(UNITS[order] for _ in range(axes) for order in orders),
    )


def _axes(check: Checker, kind: str | None, value: Any) -> int | None:
    axes = check.integer("model.axes", value, 1)
    if axes is not None and axes > len(AXES):
        check.note("model.axes", "1, 2 or 3", shown(value))
        return None
    if axes is not None and axes != 2 and kind == TURN:
        check.note("model.axes", "2, the plane of a coordinated turn", shown(value))
        return None
    return axes


def read_step(check: Checker, table: Mapping[str, Any], steps: int) -> np.ndarray | None:
    """Read model.step, seconds since the step before, () or (steps,); the entry of step 1 is that of step 2."""
    expected = f"a time from {SHORTEST:g} to {LONGEST:g} s, or one per step"
    T = check.series("model.step", table.get("step", 1.0), expected, steps)
    if T is None:
        return None
    if T.ndim:
        T = np.concatenate([T[1:2] if steps > 1 else np.ones(1), T[1:]])
    wrong = (T < SHORTEST) | (T > LONGEST)
    if wrong.any():
        check.note("model.step", expected, f"{T[wrong][0]:g}")
        return None
    return T


def _noise(check: Checker, value: Any) -> float | None:
    expected = "a density (continuous) or a standard deviation (piecewise) of at least 0"
    if value is None:
        check.note("model.noise", expected, "nothing")
        return None
    return check.number("model.noise", value, expected, lambda noise: 0 <= noise <= LOUDEST)


def _turn_rate(check: Checker, kind: str | None, value: Any, steps: int) -> np.ndarray | None:
    """Turn rate in rad/s, () or (steps,); 0 where nothing turns."""
    if kind != TURN:
        if value is not None and kind is not None:
            check.note("model.turn_rate", f'nothing unless model.kind is "{TURN}"', shown(value))
        return np.zeros(())
    expected = "the turn rate in rad/s, or one per step"
    if value is None:
        check.note("model.turn_rate", expected, "nothing")
        return None
    rate = check.series("model.turn_rate", value, expected, steps)
    if rate is not None and (np.abs(rate) > LONGEST).any():
        check.note("model.turn_rate", expected, f"{rate.flat[np.abs(rate).argmax()]:g}")
        return None
    return rate


def _constant(values: np.ndarray) -> np.ndarray:
    """One value for all steps where all but the unused first are alike."""
    return values[-1] if values.ndim and (values[1:] == values[-1]).all() else values


def layout_of(kind: str | None, states: Sequence[str]) -> Layout | None:
    """Tell which states are places, velocities and accelerations: by a kind's order, else by their names.

    Names tell it where x, or x and y, or x, y and z are among them, and of velocities (vx …) and accelerations (ax …)
    those that are there for every axis.
    """
    if kind in ORDERS:
        n = ORDERS[kind]
        return Layout(*(tuple(range(order, len(states), n)) for order in range(n)))
    names = list(states)
    axes = [axis for axis in AXES if axis in names]
    if not axes or axes != list(AXES[: len(axes)]):
        return None
    wanted = [[before + axis for axis in axes] for before in BEFORE]
    return Layout(*(tuple(map(names.index, group)) if set(group) <= set(names) else () for group in wanted))


def read_course(
    check: Checker, table: Mapping[str, Any], layout: Layout | None, model: Model, steps: int
) -> Course | None:
    """Read [model.nominal]: what sensors look at; None where the states do not tell the place.

    Parameters
    ----------
    table : [model].
    layout, model : what came of it.
    """
    T = read_step(Checker(), table, steps)
    if layout is None or T is None:
        if layout is None and table.get("nominal") is not None:
            check.note("model.nominal", PLACES, f"states {', '.join(model.states)}")
        return None
    return Course(layout, T, _nominal(check, table.get("nominal"), model, layout, T, steps))


PLACES = "model.kind, or states named x, y and z (as many as there are; vx … their velocities), that tell the place"


def _nominal(check: Checker, table: Any, model: Model, layout: Layout, T: np.ndarray, steps: int) -> np.ndarray | None:
    if not isinstance(table, Mapping):
        return None
    if table.get("position") is None:
        check.note("model.nominal.position", f"{layout.axes} coordinates at step 1, or as many per step", "nothing")
    place = check.vector("model.nominal.position", table.get("position"), layout.axes, steps)
    each = steps if place is not None and place.ndim == 3 else None
    rest = {"velocity": layout.velocity, "acceleration": layout.acceleration}
    given = {}
    for key, states in rest.items():
        if table.get(key) is not None and not states:
            check.note(f"model.nominal.{key}", f"nothing, since the model has no {key}", shown(table[key]))
        elif (found := check.vector(f"model.nominal.{key}", table.get(key), layout.axes, each)) is not None:
            given[states] = found[..., 0]
    if place is None:
        return None
    place = place[..., 0]
    path = (
        _moved(model, {layout.place: place, **given}, steps)
        if place.ndim == 1
        else _along(model.dimension, {layout.place: place, layout.velocity: rates(place[:steps], T), **given}, steps)
    )
    if not (np.abs(path) <= LARGEST).all():
        check.note("model.nominal", f"a path that stays within {LARGEST:g}", "one that model.F takes beyond")
        return None
    path.setflags(write=False)
    return path


def _moved(model: Model, start: Mapping[tuple[int, ...], np.ndarray], steps: int) -> np.ndarray:
    """Nominal states (steps, d) from those of step 1."""
    x = np.zeros((model.dimension, 1))
    for states, values in start.items():
        x[list(states), 0] = values
    F, Bu = (over_steps(M, steps) for M in (model.F, model.Bu))
    path = [x]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, steps):
            path.append(F[k] @ path[-1] + Bu[k])
    return np.array(path)[..., 0]


def _along(d: int, given: Mapping[tuple[int, ...], np.ndarray], steps: int) -> np.ndarray:
    """Nominal states (steps, d) from those that are given."""
    path = np.zeros((steps, d))
    for states, values in given.items():
        if states:
            path[:, list(states)] = values[:steps] if values.ndim == 2 else values
    return path


def rates(places: np.ndarray, T: Any) -> np.ndarray:
    """Velocities (steps, D) along places (steps, D): over the time T, () or (steps,), from the place before.

    Step 1 has that of step 2; a single step has none.
    """
    if len(places) == 1:
        return np.zeros_like(places)
    T = np.broadcast_to(T, len(places))[1:, None]
    moved = np.diff(places, axis=0) / T
    return np.concatenate([moved[:1], moved])
