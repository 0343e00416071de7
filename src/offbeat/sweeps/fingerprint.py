"""A fingerprint of the numbers that this process makes: the bits of small trainings.

A training that goes on for thousands of steps amplifies a difference in the last digit, so runs are
alike only if each bit of each step is. Whether they are is measured, not guessed from the source: a
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
"""They meet each part that the zoo's models consist of, but for Elman and LSTM cells."""


def walks(trajectories: int, rows: int, channels: int) -> Dataset:
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
        walks(64, 40, 3), SplitConfig(window=30, observed_fraction=0.5)
    )
    whole = hashlib.sha256()
    for name in _MODELS:
        model = make_model(name, train)
        config = train_config(name, epochs=2, batch_size=20)
        fit(model, train, validation, config, progress=False)
        scores = evaluate({name: model}, test).scores
        whole.update(digest(model.state_dict(), scores, {name: name for name in SCORINGS}).encode())
    return whole.hexdigest()[:12]
