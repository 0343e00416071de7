"""Hiding rows: what is known to the score becomes unseen by the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError


def thin(dataset: Dataset, observed_fraction: float, *, seed: int = 0) -> Dataset:
    """Hides rows at random: exactly `int(rows * observed_fraction)` stay, all channels together.

    Only rows in which something is observed are drawn from and counted. Values stay known, so a
    score can be computed at hidden cells.

    Args:
        dataset: trajectories to thin.
        observed_fraction: share of the rows that stay observed, above 0 and at most 1.
        seed: of the draw.

    Raises:
        InputError: the fraction is not above 0 and at most 1, or it would leave no row.
    """
    if not 0 < observed_fraction <= 1:
        raise InputError(
            f"observed_fraction must be above 0 and at most 1, got {observed_fraction!r}; "
            "0.3 keeps 30 % of the rows"
        )
    random = np.random.default_rng(seed)
    thinned = []
    for i, trajectory in enumerate(dataset):
        rows = np.flatnonzero(trajectory.observed.any(axis=1))
        # 0.7 * 100 is 70.0 and 0.29 * 100 is 28.999...: the decimal that was meant counts.
        count = int(round(len(rows) * observed_fraction, 9))
        if count == 0:
            raise InputError(
                f"observed_fraction {observed_fraction} of the {len(rows)} observed rows of "
                f"trajectory {i} leaves none; use a larger fraction or longer trajectories"
            )
        kept = np.zeros(trajectory.rows, dtype=bool)
        kept[random.choice(rows, size=count, replace=False)] = True
        thinned.append(replace(trajectory, observed=trajectory.observed & kept[:, None]))
    return Dataset(tuple(thinned), {**dataset.meta, "observed_fraction": observed_fraction})
