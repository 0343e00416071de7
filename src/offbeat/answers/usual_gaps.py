"""Fills between two measurements of a channel that lie as close as usual.

Tasks mask measured values, so the shortest gap of a channel in them is two usual ones. But a log
with sensors at several rates has rows between the measurements of a slower one, and an even grid
lies between all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from offbeat.answers.blend import Blend
from offbeat.data.trajectory import Dataset

_USUAL = 0.25
"""Quantile of the gaps of a channel that is its usual one, where rows are masked as well."""


def for_usual_gaps(blend: Blend, dataset: Dataset) -> Blend:
    """A blend that fills gaps as long as usual as those of twice that length.

    The shortest gap of a channel that a task can mask is two usual ones. For shorter ones a blend
    has weights and intervals of other channels alone, which report more often.

    Args:
        blend: any.
        dataset: whose gaps are filled.
    """
    both = blend.both
    many = len(both.keys.bins)
    weights, gamma, units = both.weights.copy(), both.gamma.copy(), both.units.copy()
    table = both.widths.table.copy()
    for c, name in enumerate(blend.names):
        if name not in dataset.names:
            continue
        at = dataset.names.index(name)
        gaps = [np.diff(t.times[t.observed[:, at]]) for t in dataset]
        found = np.concatenate(gaps)
        if not len(found):
            continue
        usual = np.quantile(found, _USUAL)
        least = int(both.keys.bins.of_age(np.array([2 * usual]))[0])
        shorter = np.r_[: least + 1, many : many + least]  # near an end of a gap, and within one
        for values in (weights, gamma, units, table):
            values[shorter, c] = values[many + least, c]
    widths = replace(both.widths, table=table)
    both = replace(both, weights=weights, gamma=gamma, units=units, widths=widths)
    return replace(blend, both=both)
