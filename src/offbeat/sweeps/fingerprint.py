"""A fingerprint of the numerics of this process: a hash of the bits of small trainings.

Thousands of training steps amplify a difference in the last digit, so runs are comparable
bit for bit only if each step is. This is measured, not derived from the source code: a
faster kernel that adds in the same order keeps the fingerprint, another default changes it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from offbeat.data.trajectory import Dataset, Trajectory

if TYPE_CHECKING:
    from torch import Tensor

    from offbeat.metrics import Scores

_MODELS = ("gru_d", "ode_rnn", "anchored_ode_gru_d")
"""Together they use each part of the zoo's models except Elman and LSTM cells."""


def random_walks(trajectories: int, rows: int, channels: int) -> Dataset:
    """Random walks on a grid of 5 ms, the same bits on every machine: sums of small integers."""
    steps = np.random.default_rng(0).integers(-8, 9, (trajectories, rows, channels))
    values = steps.cumsum(axis=1).astype(np.float64) / 64
    times = 0.005 * np.arange(rows, dtype=np.float64)
    return Dataset(tuple(Trajectory(times, each) for each in values))


def digest(
    weights: Mapping[str, Tensor], scores: Mapping[str, Scores], scorings: Mapping[str, str]
) -> str:
    """A hash of all bits of a model's weights and of its scores.

    Args:
        weights: by name.
        scores: by predictor.
        scorings: names to hash, each with the name of its score.
    """
    found = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        found.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
    for who in sorted(scores):
        errors = [(name, getattr(scores[who], score).mse) for name, score in scorings.items()]
        found.update(repr(errors).encode())
    return found.hexdigest()[:12]


@cache
def fingerprint() -> str:
    """Hash of weights and scores of some models of the zoo, trained for a few steps each."""
    from offbeat.config import SplitConfig
    from offbeat.data.splits import apply_split
    from offbeat.evaluation import evaluate
    from offbeat.metrics import SCORINGS
    from offbeat.models.zoo import make_model, train_config
    from offbeat.training import fit

    train, validation, test = apply_split(
        random_walks(64, 40, 3), SplitConfig(window=30, observed_fraction=0.5)
    )
    whole = hashlib.sha256()
    for name in _MODELS:
        model = make_model(name, train)
        config = train_config(name, epochs=2, batch_size=20)
        fit(model, train, validation, config, progress=False)
        scores = evaluate({name: model}, test).scores
        whole.update(digest(model.state_dict(), scores, {name: name for name in SCORINGS}).encode())
    return whole.hexdigest()[:12]
