"""A fingerprint of the numbers that this process makes: the bits of small trainings.

A training that goes on for thousands of steps blows a difference in the last digit up, so runs are
alike only if each bit of each step is. Whether they are is measured, not guessed from the source: a
faster kernel that adds in the same order keeps the fingerprint, another default changes it.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache

import numpy as np

from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.evaluation import evaluate
from offbeat.models.zoo import make_model
from offbeat.training import fit
from thesis.protocol import CONTROLS, MODELS, Protocol, Run
from thesis.record import SCORINGS

_TRAJECTORIES, _ROWS, _CHANNELS = 160, 120, 14
_FRACTION, _EPOCHS = 0.3, 2
_OLD = re.compile(r"^head\.")
"""Names are hashed as they were when the record was begun: weights of the head as `decoder.*`."""


def walks() -> Dataset:
    """Random walks on a grid of 5 ms, the same bits on every machine: sums of small integers."""
    steps = np.random.default_rng(0).integers(-8, 9, (_TRAJECTORIES, _ROWS, _CHANNELS))
    values = steps.cumsum(axis=1).astype(np.float64) / 64
    times = 0.005 * np.arange(_ROWS, dtype=np.float64)
    return Dataset(tuple(Trajectory(times, each) for each in values))


@cache
def fingerprint(protocol: Protocol | None = None) -> str:
    """Hash of weights and scores of every model of the protocol, trained for a few steps.

    Windows, masks, split, order of batches, generator, optimizer, schedule and scoring are those
    of the protocol; full batches and one that is not full occur. What no small training meets is
    not in it: gradients are never as large here as the norm that the anchored model's are cut to.
    It takes a few seconds.

    Args:
        protocol: by default the thesis'.
    """
    whole = "".join(fingerprints(protocol or Protocol()).values())
    return hashlib.sha256(whole.encode()).hexdigest()[:12]


def fingerprints(protocol: Protocol) -> dict[str, str]:
    """The hash of each model by its label; `fingerprint` is the hash of them all.

    The controls are left out: they consist of nothing that the others do not meet.
    """
    recorded = walks()
    scaler = Scaler.fit(protocol.scaler, recorded)
    found, parts = dict[str, str](), None
    for label in [label for label in MODELS if label not in CONTROLS]:
        digest = hashlib.sha256()
        run = Run(2, label, _FRACTION, 0, _EPOCHS, seed_draw=1, seed_weights=2)
        parts = parts or protocol.cut(recorded, run)
        train, validation, test = parts
        model = make_model(
            protocol.model_config(label), train, scaler=scaler, seed=run.seed_weights
        )
        fit(model, train, validation, protocol.train_config(run), progress=False)
        state = {_OLD.sub("decoder.", name): value for name, value in model.state_dict().items()}
        for name, weights in sorted(state.items()):
            digest.update(name.encode() + weights.detach().cpu().numpy().tobytes())
        scores = evaluate({label: model}, test, seed=run.seed_draw).scores
        for who in sorted(scores):
            errors = [(name, getattr(scores[who], score).mse) for name, score in SCORINGS.items()]
            digest.update(repr(errors).encode())
        found[label] = digest.hexdigest()[:12]
    return found
