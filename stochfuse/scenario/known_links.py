"""What is known of links, wherever it comes from: a file, a packet log in memory, or a scenario.

A scenario's links are what its predictions use: of [network.radio] with the agents' places, of network.link or of its
cases; 0 where the architecture or network.hears lets nobody hear.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stochfuse.errors import UsageError
from stochfuse.scenario.links import Links, jeffreys, links_of_table, read_links
from stochfuse.scenario.network import Network, reachable
from stochfuse.scenario.scenario import Scenario, is_preset, load_scenario

MOST_NUMBERS = 4_000_000
"""Link probabilities that are laid out one by one."""


def links(source: Any, **how: Any) -> Links:
    """Return what is known of links: of a file, a packet log in memory, or a scenario.

    Parameters
    ----------
    source : a path, see `read_links`; columns by name or a DataFrame, see `links_of_table`; or a scenario: one, a
        preset's name, a path that ends in .toml or .json, or a mapping with a scenario file's keys.
    **how : columns, sent, step; see `read_links`.

    Raises
    ------
    UsageError
        If it is none of these; with line and column.

    Examples
    --------
    >>> import stochfuse as sf
    >>> log = {"seq": [1, 2, 3], "sender": ["a"] * 3, "receiver": ["b"] * 3, "received": [1, 0, 1]}
    >>> float(sf.links(log).link[1, 0].round(3))
    0.667
    >>> sf.links("road-5").link.shape                     # step, receiver, sender
    (20, 5, 5)
    """
    if is_scenario(source):
        if how:
            raise UsageError(f"{next(iter(how))}: expected a file of links to go with it, got a scenario")
        return links_of_scenario(source if isinstance(source, Scenario) else load_scenario(source))
    if isinstance(source, str | Path):
        return read_links(source, **how)
    return links_of_table(source, **how)


def is_scenario(source: Any) -> bool:
    """Whether a source of links is a scenario, or names one; "-" is one on standard input."""
    if isinstance(source, str | Path):
        return is_preset(source) or str(source) == "-" or Path(source).suffix.lower() in (".toml", ".json")
    return isinstance(source, Scenario) or (isinstance(source, Mapping) and "network" in source)


def links_of_scenario(scenario: Scenario) -> Links:
    """Return the links that a scenario gives.

    Raises
    ------
    UsageError
        If it gives none, or more than can be laid out.
    """
    network = scenario.network
    if network.link is None and not network.cases:
        raise UsageError(
            f"{scenario.name}: expected links (network.link, network.radio or network.case), got none: its predictions "
            "are a table over the link probability"
        )
    given = [link for link in (network.link, *(link for _, link in network.cases)) if link is not None]
    if network.agents**2 * sum(len(link) if link.ndim in (1, 3) else 1 for link in given) > MOST_NUMBERS:
        raise UsageError(f"{scenario.name}: expected at most {MOST_NUMBERS:,} links, got {network.agents:,} agents")
    link = _laid_out(given[0], network)
    low = high = np.full_like(link, np.nan)
    sent, received = (None, None) if network.counts is None else (M.astype(int) for M in network.counts)
    if sent is not None and received is not None:
        low, high = (np.minimum(1.0, network.scale * end) for end in jeffreys(sent, received))
    return Links(
        source=scenario.name,
        kind=_kind(network),
        nodes=network.names or tuple(map(str, range(1, network.agents + 1))),
        link=link,
        low=low,
        high=high,
        sent=sent,
        received=received,
        burst=_bursts(network),
        delay=None if network.delay == (1.0,) else network.delay,
        notes=_notes(network),
        architecture=network.architecture,
        steps=network.steps,
        places=network.places,
        radio=network.radio,
        cases=tuple((name, _laid_out(link, network)) for name, link in network.cases),
    )


def _laid_out(link: np.ndarray, network: Network) -> np.ndarray:
    """Every link by itself, (n, n) or (steps, n, n); nothing of an agent to itself."""
    full = np.where(reachable(network), link if link.ndim >= 2 else link[..., None, None], 0.0)
    full[..., range(network.agents), range(network.agents)] = np.nan
    return full


def _kind(network: Network) -> str:
    if network.radio is not None:
        faded = f" {network.radio.shadowing:g} dB" if network.radio.fading == "shadowing" else ""
        return f"radio, fading {network.radio.fading}{faded}"
    return "network.burst" if network.burst is not None else "network.link" if network.link is not None else "cases"


def _bursts(network: Network) -> Mapping[tuple[int, int], Mapping[str, float]] | None:
    if network.burst is None:
        return None
    keys = ("good_to_bad", "bad_to_good", "good", "bad")
    burst: Mapping[str, float] = {key: float(value) for key, value in zip(keys, network.burst, strict=True)}
    receivers, senders = np.nonzero(reachable(network))
    return dict.fromkeys(zip(receivers.tolist(), senders.tolist(), strict=True), burst)


def _notes(network: Network) -> tuple[str, ...]:
    notes = []
    if network.architecture == "cyclic":
        notes.append("cyclic: every agent hears the next one only; all other links are 0")
    if network.hears is not None:
        notes.append("links that network.hears leaves out are 0")
    if any(burst is not None for burst in network.case_bursts):
        notes.append("of a bursty case the mean is shown")
    return tuple(notes)
