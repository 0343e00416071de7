"""Predictions at any times, in original units."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from offbeat.answers.answer import Answer
from offbeat.answers.blend import Blend, model_rows
from offbeat.config import check_seed
from offbeat.data.rows import add_rows
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.devices import placed
from offbeat.errors import InputError
from offbeat.models.base import BaseModel, of_channels
from offbeat.models.corrected import CorrectedModel
from offbeat.models.model import Model

Times = ArrayLike | Sequence[ArrayLike]


class HasBlend(Protocol):
    """What `offbeat.learn` returns: a blend, and more."""

    @property
    def blend(self) -> Blend:
        """Answers predictions, fills and forecasts."""


Answering = BaseModel | Blend | HasBlend
"""What can be asked: a trained model, a blend, or the result of `offbeat.learn`."""


def answering(model: Answering) -> BaseModel | Blend:
    """The model or the blend that answers.

    Args:
        model: a trained model, a blend, or the result of `offbeat.learn`.

    Raises:
        InputError: it is something else.
    """
    found = getattr(model, "blend", model)
    if isinstance(found, BaseModel | Blend):
        return found
    raise InputError(
        f"expected a trained model, a blend or the result of offbeat.learn, got "
        f"{type(model).__name__}; offbeat.load_run reads the folder of a run"
    )


def predict(
    model: Answering,
    dataset: Dataset,
    *,
    times: Times | None = None,
    seed: int = 0,
    size: int = 500,
    device: str | torch.device | None = None,
) -> Dataset:
    """Predicts each trajectory at any times, from observations strictly before each time.

    The model's input transforms are applied to the data and undone on the predictions: an angle
    that was given wrapped is predicted wrapped. A registered model gets each requested time as a
    row in which nothing is observed.

    Args:
        model: a trained model, or a blend or the result of `learn`, whose answers have intervals.
        dataset: what was observed; masked values are not used.
        times: s, on the clock of the trajectories, strictly increasing: one time or one array for
            all trajectories, or one array per trajectory. By default the times of each
            trajectory's own rows: one step ahead.
        seed: of the generator of self-feeding.
        size: trajectories per batch.
        device: that the model is computed on, as of `fit`, and moved back from; by default its own.

    Returns:
        One trajectory of predictions per trajectory, in original units, at the requested times;
        its channels are in the order of the model. Exogenous channels, which are not predicted, are
        NaN. Each is an `Answer`.

    Raises:
        InputError: other channels than the model's, times that are not finite numbers in
            increasing order, or a model that cannot predict at any time (see
            `thesis_config`).
    """
    model, dataset = answering(model), Dataset.of(dataset)
    check_seed(seed)
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise InputError(f"size must be a number of trajectories of at least 1, got {size!r}")
    if times is not None:
        check_any_time(model)
    asked = [t.times for t in dataset] if times is None else times_of_each(times, len(dataset))
    transforms = model.transforms
    applied = transforms.apply(of_channels(dataset, model.names, model.units))
    results: list[Trajectory] = []
    for first in range(0, len(dataset), size):
        part = applied[first : first + size]
        asked_here = asked[first : first + size]
        merged = tuple(add_rows(t, at) for t, at in zip(part, asked_here, strict=True))
        with placed(model, device, batch=len(merged)):
            answers = _every_row(model, replace(part, trajectories=merged), seed)
        for union, at, answer in zip(merged, asked_here, answers, strict=True):
            results.append(answer.rows_at(np.searchsorted(union.times, at)))
    return transforms.undo(Dataset(tuple(results), {"predicted_by": model.name}), dataset)


def _every_row(model: BaseModel | Blend, dataset: Dataset, seed: int) -> list[Answer]:
    """The answers at every row of a data set that is transformed and in the model's order."""
    if isinstance(model, Blend):
        answers = model.causal(dataset, seed=seed)
    else:
        rows = model_rows(model, dataset, seed=seed, size=len(dataset))
        assert rows is not None
        answers = [
            Answer(
                t.times,
                values,
                names=model.names,
                units=model.units,
                roles=model.roles,
                origin=t.origin,
            )
            for t, values in zip(dataset, rows, strict=True)
        ]
    return [without_exogenous(answer, model.predicted) for answer in answers]


def without_exogenous(answer: Answer, predicted: NDArray[np.bool_]) -> Answer:
    """An answer that is NaN in channels that are not predicted."""
    if predicted.all():
        return answer
    values = np.where(predicted, answer.values, np.nan)
    return replace(answer, values=values, observed=answer.observed & predicted)


def in_model_order(model: BaseModel | Blend, dataset: Dataset) -> Dataset:
    """The data set with its channels in the order of the model; unchanged if the channels differ.

    Actions that the model does not know are left out.
    """
    dataset = dataset.without_actions_but(model.names)
    same = set(dataset.names) == set(model.names)
    return dataset.select(model.names) if same and dataset.names != model.names else dataset


def increasing_seconds(value: ArrayLike, what: str) -> NDArray[np.float64]:
    """Returns one number or several, in s, as an array.

    Args:
        value: a number, or a list or array of numbers.
        what: name of the value, for the message.

    Raises:
        InputError: it is not a number or list; it is empty, not finite, or not increasing.
    """
    try:
        array = np.atleast_1d(np.asarray(value))
    except (TypeError, ValueError):  # lists of different lengths
        array = np.empty((0, 0))
    if array.ndim == 1 and (array.dtype.kind in "iuf" or not array.size):
        seconds = array.astype(np.float64)
        if len(seconds) and np.isfinite(seconds).all() and (np.diff(seconds) > 0).all():
            return seconds
    raise InputError(
        f"{what} must be one number of seconds or several that are finite and increase strictly, "
        f"got {' '.join(reprlib.repr(value).split())}; give them such as 0.5 or [0.1, 0.5]"
    )


def times_of_each(times: Times, count: int) -> list[NDArray[np.float64]]:
    """(times,) s of each trajectory.

    Args:
        times: one time or one array for all trajectories, or one array per trajectory.
        count: number of trajectories.

    Raises:
        InputError: they are not finite numbers in increasing order, or of another count.
    """
    if hasattr(times, "__array__"):
        times = np.atleast_1d(np.asarray(times))
    nested = isinstance(times, list | tuple | np.ndarray) and any(np.ndim(t) for t in times)
    if not nested:
        return [increasing_seconds(times, "times")] * count  # type: ignore[arg-type]
    each: list[ArrayLike] = list(times)  # type: ignore[arg-type]
    if len(each) != count:
        raise InputError(
            f"got times for {len(each)} trajectories, the data has {count}; give one array for "
            "all, or one per trajectory"
        )
    return [increasing_seconds(at, f"times of trajectory {i}") for i, at in enumerate(each)]


def predicts_any_time(model: BaseModel | Blend) -> bool:
    """Whether a model predicts at other times than those of its rows.

    Args:
        model: trained or not.
    """
    try:
        check_any_time(model)
    except InputError:
        return False
    return True


def check_any_time(model: BaseModel | Blend) -> None:
    """Checks that a row in which nothing is observed changes no other prediction.

    Args:
        model: trained or not.

    Raises:
        InputError: it would change one.
    """
    model = model.forward if isinstance(model, Blend) else model  # type: ignore[assignment]
    if isinstance(model, CorrectedModel):
        model = model.inner
    if not isinstance(model, Model):
        return
    for field, value, meaning in (
        ("readout", "last_row", "predicts the same for any time"),
        ("update_rows", "every", "is changed by every row, and a requested time is one more row"),
        ("decay_rows", "every_row", "decays at every row, and a requested time is one more row"),
        ("time_input", "gap", "uses the gap since the row before, which a requested time splits"),
        ("clock", "first_row", "starts at the first row, and a requested time can be before it"),
        ("self_feeding", True, "draws a random number at every row, also at a requested time"),
    ):
        found = getattr(model.config, field)
        if found == value or (value is True and found):
            raise InputError(
                f"a model with {field}={found!r} {meaning}: it can't predict at other times than "
                f"those of its rows; leave times out, or train one with another {field}"
            )
