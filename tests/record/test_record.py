"""Every answer of 0.1, still the same to 1e-12 (`python -m tests.record compare` shows by how much)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import stochfuse as sf
from stochfuse.errors import UsageError
from tests.record.__main__ import GROWN, REFUSED_NOW, TOLERANCE, answer, differences, recorded
from tests.record.calls import calls

PARTS = 8


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_answers_are_those_of_0_1(part):
    made, found = calls(), []
    for name, wanted in list(recorded().items())[part::PARTS]:
        if name in GROWN:
            continue
        if name in REFUSED_NOW:
            with pytest.raises(UsageError):
                answer(made[name])
            continue
        found += [(where, gap) for where, gap in differences(wanted, answer(made[name]), name) if gap > TOLERANCE]
    assert not found, f"{len(found)} differ, {max(found, key=lambda d: d[1])}"


def test_a_difference_is_seen():
    assert differences({"a": [1.0, 2.0]}, {"a": [1.0, 2.1]})[0][1] == pytest.approx(0.1 / 2.1)
    assert differences({"a": 1}, {})[0][1] == np.inf
    assert differences([1.0, 1e-30], [1.0, 2e-30])[0][1] < 1e-12
    assert differences([1.0], [1.0, 2.0])[0][1] == np.inf


NAMES = """AgentsNeeded Comparison FusionGraph LeastLink MessageLoad NoAnswerError Prediction Scenario ScenarioError
    Sensitivity StochfuseError UsageError __version__ agents_needed check_results compare compare_estimators
    derive_general derive_optimal derive_simplified least_link load_history load_scenario message_load predict
    predict_many predict_states read_results sensitivity share_of_gain steady_state study"""


def test_every_public_name_of_0_1_is_still_there_and_the_version_is_the_changelogs():
    assert set(NAMES.split()) <= set(sf.__all__)
    assert all(getattr(sf, name) is not None for name in NAMES.split())
    headings = re.findall(r"^## (\S+)", (Path(__file__).parents[2] / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert headings[0] in ("Unreleased", sf.__version__)
