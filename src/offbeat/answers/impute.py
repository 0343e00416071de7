"""Imputation of values that were not observed, causal or two-sided."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from offbeat.answers.answer import Answer
from offbeat.answers.blend import Blend
from offbeat.answers.predict import (
    Answering,
    Times,
    answering,
    check_any_time,
    predict,
    times_of_each,
    without_exogenous,
)
from offbeat.data.rows import add_rows, times_at_rate
from offbeat.data.trajectory import Dataset
from offbeat.devices import placed
from offbeat.errors import InputError, one_of
from offbeat.models.base import BaseModel, of_channels

MODES = ("causal", "two_sided")
"""Modes of imputation: from the past alone, or from both sides."""


def impute(
    model: Answering,
    dataset: Dataset,
    *,
    mode: Literal["causal", "two_sided"] | None = None,
    times: Times | None = None,
    rate_hz: float | None = None,
    seed: int = 0,
    device: str | torch.device | None = None,
) -> Dataset:
    """Fills every value that is not observed: masked ones, and those that were never measured.

    A log has no rows where all of its sensors were out. `rate_hz`, or `times`, adds rows there.

    `causal` fills with the prediction from what was observed strictly before the row. `two_sided`
    also uses what was observed after it; see `offbeat.answers.both_sides`. Neither uses masked
    values.

    Args:
        model: a trained model; or a blend or the result of `learn`, whose fills have intervals.
        dataset: the observed data.
        mode: `causal` or `two_sided`; by default two-sided where the model is a blend.
        times: s, at which a row is added where there is none: one array for all trajectories, or
            one per trajectory, as of `predict`.
        rate_hz: adds rows at this rate, from the first to the last row of each trajectory, where
            no row is within half a period.
        seed: of the generator of self-feeding.
        device: that the model is computed on, as of `fit`, and moved back from; by default its own.

    Returns:
        The trajectories in original units, channels in the order of the model. No value is
        NaN; `observed` is True where it was measured, and False where it was filled.

    Raises:
        InputError: other channels than the model's, two-sided filling with a single model, `times`
            and `rate_hz` together or invalid, or rows to add for a model that cannot predict at
            any time.
    """
    model, dataset = answering(model), Dataset.of(dataset)
    mode = mode or ("causal" if isinstance(model, BaseModel) else "two_sided")
    one_of("mode", mode, MODES)
    if times is not None and rate_hz is not None:
        raise InputError("give times or rate_hz, not both")
    if times is not None or rate_hz is not None:
        check_any_time(model)
        added = (
            times_of_each(times, len(dataset))
            if times is not None
            else [times_at_rate(t, rate_hz) for t in dataset]  # type: ignore[arg-type]
        )
        rows = (add_rows(t, at) for t, at in zip(dataset, added, strict=True))
        dataset = replace(dataset, trajectories=tuple(rows))
    transforms = model.transforms
    dataset = of_channels(dataset, model.names, model.units)
    applied = transforms.apply(dataset)
    if mode == "causal":
        found = predict(model, applied, seed=seed, device=device)
        answers = [t for t in found if isinstance(t, Answer)]
    elif isinstance(model, Blend):
        with placed(model, device, batch=len(applied)):
            every = model.fill(applied, seed=seed)
        answers = [without_exogenous(a, model.predicted) for a in every]
    else:
        raise InputError(
            "mode 'two_sided' needs a blend, got a single model; train one with offbeat train, or "
            "fit_blend, or fill with mode 'causal'"
        )
    notes = {**dataset.meta, "filled_by": model.name, "filled": mode}
    undone = transforms.undo(Dataset(tuple(answers), notes), dataset)
    filled = []
    for t, given in zip(undone, dataset, strict=True):
        assert isinstance(t, Answer)
        seen = given.observed
        filled.append(
            replace(
                t,
                values=np.where(seen, given.values, t.values),
                observed=seen,
                roles=given.roles,
                origin=given.origin,
                unit=None if t.unit is None else np.where(seen, 0.0, t.unit),
                beyond=None if t.beyond is None else t.beyond & ~seen,
            )
        )
    return Dataset(tuple(filled), notes)
