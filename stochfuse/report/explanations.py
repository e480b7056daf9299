"""What the words mean that outputs use: a paragraph each, from the registry where it declares them."""

from __future__ import annotations

import re
from textwrap import fill
from typing import NamedTuple

from stochfuse.errors import UsageError, nearest
from stochfuse.report.table import Report
from stochfuse.scenario import capabilities, registry

SCHEMA = "stochfuse.explanation/1"


def _glossary(text: str) -> dict[str, str]:
    """Return the paragraphs by their words; what continues one is indented."""
    entries = (entry.partition(": ") for entry in re.split(r"\n(?! )", text.strip()))
    return {word: " ".join(paragraph.split()) for word, _, paragraph in entries}


TERMS = _glossary("""
prior: The estimate before the measurement of a step: predicted from the step before, k|k-1.
posterior: The estimate after a step's measurement and fusion. Every table shows posteriors unless it says prior.
link probability: µ: the probability that one message from one agent reaches another within a step. Without bursts,
  messages are lost independently of each other and of the data.
critical link probability: The µ above which the averaged covariance stays bounded where a mode of the model grows by
  itself: 1 - 1/|eigenvalue|^2 where one message shows the state, more where it shows a part (Sinopoli et al. 2004).
  See stochfuse solve --critical.
steady state: What an expectation tends to as the steps go on; where sensors have periods a cycle, of which the mean
  is shown. A fixed point of (54); of the optimum enclosed; anything else sampled after a burn-in, by which two
  samples of the same arrivals, from starts far apart, no longer differ. See stochfuse predict --steady.
exact: An average over every outcome of which messages arrive, each with its probability; only rounding is left, and
  its reach is checked.
approximate: The mean field: after every step the average covariance stands for all outcomes, and the next step goes
  on from it. Fast for any number of agents; within a few per cent of the exact average where agents and links are
  alike, and tens of per cent off where they are not.
bound: The value is proved to lie within the relative distance that a note gives.
sampled: A mean over drawn outcomes; ± is one standard error, the next sample's mean lies within two of them in 95 %
  of all cases.
control variate: What is drawn along with a sampled value and has a known mean: by what its own sample is off, the
  value is corrected. Here the exact optimum of every outcome, and of that itself a filter of the numbers heard; see
  --control and --precision.
pedigree: Of an estimate: the set of measurements and first estimates that went into it. What two pedigrees have in
  common must be counted once.
innovation: What a measurement says beyond the prediction, z - H x; its covariance is H P H' + R.
NEES: Normalised estimation error squared, e' P^-1 e. Its mean is the state's dimension where the claim is true; more
  where it is overconfident.
NIS: Normalised innovation squared, the same of the innovation; needs no truth.
realised: What an estimator's error came to on data, x̂ less the truth: a sample, to be laid beside what is predicted,
  over noises and arrivals, or given these very arrivals. See stochfuse run and simulate.
replay: One record of what arrived and what was measured, followed step by step by the same estimators that other
  engines average.
mean field: See approximate.
ad-hoc: Every message reaches each agent that could hear it, or not, independently of the others.
broadcast: A message reaches everyone, or no one.
cyclic: Agents in a ring: each hears the next one only.
nominal path: Where a target is meant to be at each step, key model.nominal. Sensors by name (range, bearing, …) are
  linearised about it, and see or do not see the target there.
burst: A link that remembers: good and bad states with a transition probability each (Gilbert, Elliott), key
  network.burst.
delay: Messages that arrive late, with given probabilities of 0, 1, … steps, key network.delay; they are brought
  forward to the step in which they arrive.
consistency: Actual divided by claimed: 1 where an estimator knows how good it is, more where it is overconfident,
  less where it is cautious.
claimed: What a filter believes of itself. It is true only if what it believes of its inputs is: a rule that counts
  shared information twice claims too little.
actual: The covariance that an estimate's error truly has, worked out from what every noise came to in it.
optimal: One Kalman filter over all measurements whose messages reached an agent, directly or through others: no
  linear rule can do better with what arrived.
""")
"""Words and their paragraphs, in the order of the handbook."""


class Entry(NamedTuple):
    """A word, what kind of thing it names, and a paragraph."""

    word: str
    kind: str
    text: str


def explanations() -> dict[str, Entry]:
    """Return every word that can be explained."""
    found = [Entry(e.name, "estimator", _sentences(e.title, f"Source: {e.source}")) for e in registry.ESTIMATOR]
    for e in registry.ENGINE:
        text = _sentences(f"{e.title}: {e.help}", f"Source: {e.source}", f"Nature: {e.nature}")
        found.append(Entry(e.name, "method", text))
    for kind, entries in (
        ("quantity", registry.QUANTITY),
        ("metric", registry.METRIC),
        ("statistic", registry.STATISTIC),
    ):
        found += [Entry(one.name.partition(":")[0], kind, _sentences(one.help)) for one in entries]
    for f in capabilities.FEATURES:
        text = _sentences(f"in a scenario file: {f.key}", "stochfuse methods --matrix shows what takes it")
        found.append(Entry(f.name, "feature of a scenario", text))
    for s in registry.SHORT:
        found.append(Entry(s.name, "method", f"Short for --estimator {s.estimator} --method {s.engine}."))
    found += [Entry(word, "term", text) for word, text in TERMS.items()]
    known: dict[str, Entry] = {}
    for one in found:
        before = known.get(one.word)
        if before is not None:
            one = Entry(one.word, f"{before.kind}, {one.kind}", f"{before.text} {one.text}")
        known[one.word] = one
    return known


def explained(word: str | None, width: int) -> tuple[str, Report]:
    """Return a word's paragraph as text of a width, and in every other form; of None all words.

    Raises
    ------
    UsageError
        If the word is not known; names the nearest.
    """
    known = explanations()
    chosen = [one for key, one in known.items() if word is None or key.lower() == word.strip().lower()]
    if not chosen:
        near = nearest(word or "", known)
        raise UsageError(f"explain: expected a word that outputs use, got '{word}'{near}; without one: all")
    text = "".join(fill(f"{one.word} ({one.kind}): {one.text}", width, subsequent_indent="  ") + "\n" for one in chosen)
    facts = {"schema": SCHEMA, "explanations": [one._asdict() for one in chosen]}
    return text, Report.of_rows(("What the words mean",), Entry._fields, chosen, facts)


def _sentences(*texts: str) -> str:
    return " ".join(f"{text[0].upper()}{text[1:].rstrip('.')}." for text in texts)
