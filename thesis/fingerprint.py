"""The fingerprint of the record: the bits of small trainings of the protocol's models."""

from __future__ import annotations

import hashlib
import re
from functools import cache

from offbeat import Scaler, evaluate, fit, make_model
from offbeat.sweeps.fingerprint import digest, random_walks
from thesis.protocol import CONTROLS, MODELS, Protocol, Run
from thesis.record import SCORINGS

_TRAJECTORIES, _ROWS, _CHANNELS = 160, 120, 14
_FRACTION, _EPOCHS = 0.3, 2
_OLD = re.compile(r"^head\.decoder\.")
"""Names as in 0.1.0, which the record was started with: weights of the head are `decoder.*`."""


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
    recorded = random_walks(_TRAJECTORIES, _ROWS, _CHANNELS)
    scaler = Scaler.fit(protocol.scaler, recorded)
    found, parts = dict[str, str](), None
    for label in [label for label in MODELS if label not in CONTROLS]:
        run = Run(2, label, _FRACTION, 0, _EPOCHS, seed_draw=1, seed_weights=2)
        parts = parts or protocol.cut(recorded, run)
        train, validation, test = parts
        model = make_model(
            protocol.model_config(label), train, scaler=scaler, seed=run.seed_weights
        )
        fit(model, train, validation, protocol.train_config(run), progress=False)
        state = {_OLD.sub("decoder.", name): value for name, value in model.state_dict().items()}
        scores = evaluate({label: model}, test, seed=run.seed_draw).scores
        found[label] = digest(state, scores, SCORINGS)
    return found
