"""Every answer of 0.1, still the same to 1e-12 (`python -m tests.record compare` shows by how much)."""

from __future__ import annotations

import numpy as np
import pytest

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
