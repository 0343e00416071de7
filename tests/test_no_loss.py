"""On logs as people have them, the blend loses to no simple baseline where that can be judged."""

from __future__ import annotations

import numpy as np
import pytest
from no_loss import compared, table

QUICK = ("short", "step_signal", "bursts")
"""A short log, set points, and uneven rows; `python tests/no_loss.py` runs all of `ODD_LOGS`."""

TASKS = 120


@pytest.mark.parametrize("name", QUICK)
def test_the_blend_loses_to_no_simple_baseline(name):
    found = compared(name, count=TASKS)
    judged = [each for each in found if each.judged]
    assert len(judged) >= 3
    assert [each for each in judged if each.counts] == [], table(found)
    ratios = [each.ratio for each in judged if each.scaled > 1e-3]
    assert np.exp(np.mean(np.log(ratios))) < 0.95, "it is better on the whole"
