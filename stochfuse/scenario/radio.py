"""Link probabilities from radio and geometry: [network.radio] and the agents' places.

    [network.radio]   transmit_power [dBm], gain [dB], exponent η, reference_distance d_0 [m], reference_loss PL(d_0)
                      [dB], sensitivity S [dBm], fading = "none" | "rayleigh" | "shadowing", shadowing σ [dB]
    [[agent]]         position = [x, y] or [x, y, z] in m, or one such list per step

Received power over the distance d_ij(k) between receiver i and sender j at step k (log-distance path loss):

    P_rx(d) = P_tx + gain − PL(d_0) − 10 η log10(d/d_0)

and the probability that it reaches the sensitivity, by what becomes of it on the way:

    none        µ = 1 where P_rx ≥ S, else 0
    shadowing   P_rx is the mean of a normal distribution in dB (log-normal shadowing):  µ = Φ((P_rx − S)/σ)
    rayleigh    P_rx is the mean of an exponential distribution in mW, one draw a message (block fading):
                µ = exp(−10^((S − P_rx)/10))

Every message is drawn anew: shadowing that stays while agents stand still is not modelled (network.burst knows memory).

Source: Rappaport, Wireless Communications, chapters 4 and 5.  Departure: the formula holds from d_0 on; nearer than d_0
the loss is that at d_0, so that two agents at one place hear each other as at d_0 (as the network simulator ns-3 does).
The loss is the same both ways, so that µ_ij = µ_ji.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from stochfuse.kalman.checks import shown
from stochfuse.scenario.checker import Checker

FADINGS = ("none", "rayleigh", "shadowing")
_LEAST_POWER = -3000.0
"""dB below the sensitivity beyond which 10^(−dB/10) would overflow, and the probability is 0 by far."""


class Radio(NamedTuple):
    """A radio link's budget; see the module.

    Parameters
    ----------
    transmit_power : P_tx in dBm.
    reference_loss : PL(d_0) in dB.
    sensitivity : S in dBm.
    gain : antenna gains of both ends, less what cables take, in dB.
    exponent : η of the path loss; 2 in free space.
    reference_distance : d_0 in m.
    fading : one of `FADINGS`.
    shadowing : σ in dB; used with fading "shadowing" only.
    """

    transmit_power: float
    reference_loss: float
    sensitivity: float
    gain: float = 0.0
    exponent: float = 2.0
    reference_distance: float = 1.0
    fading: str = "none"
    shadowing: float = 0.0

    def received(self, distance: np.ndarray | float) -> np.ndarray:
        """Received power P_rx in dBm over distances in m."""
        ratio = np.maximum(np.asarray(distance, dtype=float) / self.reference_distance, 1.0)
        return self.transmit_power + self.gain - self.reference_loss - 10.0 * self.exponent * np.log10(ratio)

    def link(self, distance: np.ndarray | float) -> np.ndarray:
        """Link probability µ over distances in m."""
        above = self.received(distance) - self.sensitivity
        if self.fading == "rayleigh":
            return np.exp(-(10.0 ** (-np.maximum(above, _LEAST_POWER) / 10.0)))
        if self.fading == "shadowing":
            from scipy.special import ndtr

            return ndtr(above / self.shadowing)
        return (above >= 0.0).astype(float)


def distances(places: Sequence[np.ndarray]) -> np.ndarray:
    """Distances d_ij between agents, (n, n), or (steps, n, n) where some are on their way.

    Parameters
    ----------
    places : of every agent (D,) or (steps, D).
    """
    at = np.stack(np.broadcast_arrays(*places), axis=-2)
    return np.linalg.norm(at[..., :, None, :] - at[..., None, :, :], axis=-1)


def links_between(radio: Radio, places: Sequence[np.ndarray]) -> np.ndarray:
    """Link probabilities µ_ij between agents at places, (n, n), or (steps, n, n) where some are on their way."""
    link = radio.link(distances(places))
    link[..., range(len(places)), range(len(places))] = 0.0
    link.setflags(write=False)
    return link


def read_radio(check: Checker, table: Any) -> Radio | None:
    """Read [network.radio]; None where there is none or something is wrong, which the checker has noted."""
    if not isinstance(table, Mapping):
        return None
    before, numbers = len(check.problems), {}
    for key in Radio._fields:
        value = table.get(key, Radio._field_defaults.get(key))
        if key != "fading" and not (key == "shadowing" and key not in table):
            expected, fits = ("a number above 0", _positive) if key in _POSITIVE else ("a number", np.isfinite)
            numbers[key] = check.number(f"network.radio.{key}", value, expected, fits)
    fading = check.choice("network.radio.fading", table.get("fading", "none"), FADINGS)
    if fading == "shadowing" and "shadowing" not in table:
        expected = 'a standard deviation in dB, since fading = "shadowing"'
        check.note("network.radio.shadowing", expected, "nothing")
    elif fading in FADINGS[:2] and "shadowing" in table:
        check.note("network.radio.shadowing", f'nothing beside fading = "{fading}"', shown(table["shadowing"]))
    if fading is None or len(check.problems) > before or None in numbers.values():
        return None
    return Radio(**numbers, fading=fading)


_POSITIVE = ("exponent", "reference_distance", "shadowing")


def _positive(number: Any) -> Any:
    return number > 0


def read_places(
    check: Checker, nodes: Sequence[Mapping[str, Any]], agents: int, steps: int, *, needed: bool
) -> tuple[np.ndarray, ...]:
    """Read the agents' places from [[agent]].

    Parameters
    ----------
    nodes : the [[agent]] tables.
    needed : whether links are worked out from them, so that none may be missing.

    Returns
    -------
    tuple of ndarray
        Of every agent (D,) or (steps, D); empty where not all have one, or something is wrong, which the checker has
        noted.
    """
    if needed and not nodes:
        expected = f"one [[agent]] table with a position for each of the {agents} agents, since network.radio is given"
        check.note("agent", expected, "nothing")
    if len(nodes) != agents:  # reading the sensors notes a wrong number of tables
        return ()
    coordinates, places = None, []
    for i, node in enumerate(nodes, start=1):
        path, value = f"agent[{i}].position", node.get("position")
        if value is None:
            if needed:
                check.note(path, "a place in m, since network.radio is given", "nothing")
            continue
        coordinates = coordinates or _coordinates(value)
        if coordinates not in (1, 2, 3):
            check.note(path, "1 to 3 coordinates in m, or one such list per step", shown(value))
            return ()
        place = check.place(path, value, coordinates, steps)
        places += [] if place is None else [place]
    return tuple(places) if len(places) == agents else ()


def _coordinates(value: Any) -> int | None:
    while isinstance(value, list | tuple) and value and isinstance(value[0], list | tuple):
        value = value[0]
    return len(value) if isinstance(value, list | tuple) else 1
