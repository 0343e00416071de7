"""Scaling of channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import frozen
from offbeat.data.trajectory import EXOGENOUS, STATE, Dataset
from offbeat.errors import InputError, one_of

ScalerKind = Literal["standardise", "robust", "min_max", "divide_by_max", "identity"]
SCALERS: tuple[str, ...] = ("standardise", "robust", "min_max", "divide_by_max", "identity")

_CLIPPED = (0.01, 0.001, 0.0)
"""Fractions of the values that `clipped` limits at either end; the first that leaves a spread."""


@dataclass(frozen=True, eq=False)
class Scaler:
    """An affine map per channel: scaled = (value - shift) / scale.

    It is fitted on the training part and saved with the model. Its arrays are
    read-only.

    Args:
        kind: `standardise`, `robust`, `min_max`, `divide_by_max` or `identity`.
        shift: (channels,) in the channels' units.
        scale: (channels,) in the channels' units, not zero.
    """

    kind: str
    shift: NDArray[np.float64]
    scale: NDArray[np.float64]

    def __post_init__(self) -> None:
        one_of("scaler", self.kind, SCALERS)
        shift = frozen(self.shift, np.float64)
        scale = frozen(self.scale, np.float64)
        if shift.ndim != 1 or shift.shape != scale.shape:
            raise InputError(f"shift and scale need one shape, got {shift.shape}, {scale.shape}")
        if not (np.isfinite(shift).all() and np.isfinite(scale).all() and (scale != 0).all()):
            raise InputError("shift and scale must be finite, and scale not zero")
        object.__setattr__(self, "shift", shift)
        object.__setattr__(self, "scale", scale)

    @classmethod
    def identity(cls, channels: int) -> Scaler:
        """Does not change values."""
        return cls("identity", np.zeros(channels), np.ones(channels))

    @classmethod
    def fit(cls, kind: str, dataset: Dataset) -> Scaler:
        """Fits a scaler to the observed values of a data set, per channel.

        Args:
            kind: `standardise`, (x - mean) / standard deviation; `robust`, (x - median) / standard
                deviation of the `clipped` values, which a few wild values do not change; `min_max`,
                (x - min) / (max - min); `divide_by_max`, (x - min) / max, the normalisation of the
                thesis, kept for comparison; or `identity`.
            dataset: the training part.

        Raises:
            InputError: a channel that is not exogenous is never observed, or its maximum is 0 under
                `divide_by_max`.
        """
        one_of("scaler", kind, SCALERS)
        count, mean, square, low, high = moments(dataset)
        check_observed(dataset.names, count, len(dataset), roles=dataset.roles)
        if kind == "robust":
            columns = [
                np.concatenate([t.values[t.observed[:, c], c] for t in dataset])
                if count[c]
                else np.zeros(1)
                for c in range(dataset.channels)
            ]
            deviation = np.array([clipped(column).std() for column in columns])
            centre = np.array([np.median(column) for column in columns])
            return cls(kind, centre, np.where(deviation > 1e-12 * np.abs(centre), deviation, 1.0))
        return cls.of_moments(kind, dataset.names, count, mean, square, low, high)

    @classmethod
    def of_moments(
        cls,
        kind: str,
        names: Sequence[str],
        count: NDArray[np.int64],
        mean: NDArray[np.float64],
        variance: NDArray[np.float64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
    ) -> Scaler:
        """A scaler of any kind but `robust`, from what `moments` measures.

        Args:
            kind: of the scaler.
            names: of the channels, for messages.
            count: (channels,) observed values.
            mean: (channels,) of them.
            variance: (channels,) of them.
            low: (channels,) smallest of them.
            high: (channels,) largest of them.

        Raises:
            InputError: it is `robust`, which needs all values; or a maximum is 0 under
                `divide_by_max`.
        """
        if kind == "identity":
            return cls.identity(len(names))
        if kind == "robust":
            raise InputError(
                "the scaler 'robust' needs all values in memory; give 'standardise', or a scaler "
                "that was fitted to a sample"
            )
        low, high = np.where(count, low, 0.0), np.where(count, high, 1.0)  # without a value
        if kind == "standardise":
            deviation = np.sqrt(variance)
            # The scale of a constant channel stays 1.
            return cls(kind, mean, np.where(deviation > 1e-12 * np.abs(mean), deviation, 1.0))
        if kind == "min_max":
            return cls(kind, low, np.where(high > low, high - low, 1.0))
        if (high == 0).any():
            name = names[int((high == 0).argmax())]
            raise InputError(
                f"divide_by_max: the maximum of channel {name!r} is 0; use 'min_max' instead"
            )
        return cls(kind, low, high)

    def scaled(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., channels) original units to scaled ones."""
        return (values - self.shift) / self.scale

    def original(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., channels) scaled values to original units."""
        return values * self.scale + self.shift

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form; floats are exact."""
        return {"kind": self.kind, "shift": self.shift.tolist(), "scale": self.scale.tolist()}

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Scaler:
        """The inverse of `to_dict`."""
        return cls(value["kind"], np.array(value["shift"]), np.array(value["scale"]))


def clipped(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values limited to their inner 98 % (winsorised): wild ones count as the largest usual ones.

    At either end, 1 % of the values, and at least two where there are 100, are set to the nearest
    of the others. Where the others are all equal, as of a switch that is rarely on, it is 0.1 %, or
    none. See Tukey, Ann. Math. Statist. 33 (1962) 1, section 14.

    Args:
        values: (n,) at least one, finite.

    Returns:
        (n,) in the same order.
    """
    ordered = np.sort(values)
    low, high = ordered[0], ordered[-1]
    for fraction in _CLIPPED:
        cut = max(int(len(values) * fraction), min(2, len(values) // 50) if fraction else 0)
        low, high = ordered[cut], ordered[len(values) - 1 - cut]
        if low < high:
            break
    return np.clip(values, low, high)


def check_observed(
    names: Sequence[str],
    count: NDArray[np.int64],
    trajectories: int,
    *,
    roles: Sequence[str] | None = None,
) -> None:
    """Checks that each channel that is to be predicted has an observed value.

    Args:
        names: of the channels.
        count: (channels,) observed values.
        trajectories: number of them, for the message.
        roles: of the channels; exogenous ones may have no value. None: all are states.

    Raises:
        InputError: a channel has none; the message names all of them.
    """
    roles = roles or [STATE] * len(names)
    never = [
        name
        for name, n, role in zip(names, count, roles, strict=True)
        if n == 0 and role != EXOGENOUS
    ]
    if never:
        raise InputError(
            f"never observed in {trajectories} training trajectories: {', '.join(never)}; leave "
            "such channels out, nothing can be learned about them"
        )


def moments(dataset: Dataset) -> tuple[NDArray[Any], ...]:
    """Count, mean, variance, minimum and maximum of the observed values, per channel."""
    values = np.concatenate([t.values for t in dataset])
    observed = np.concatenate([t.observed for t in dataset])
    count = observed.sum(axis=0)
    safe = np.maximum(count, 1)
    mean = np.where(observed, values, 0).sum(axis=0) / safe
    variance = (np.where(observed, values - mean, 0) ** 2).sum(axis=0) / safe
    low = np.where(observed, values, np.inf).min(axis=0)
    high = np.where(observed, values, -np.inf).max(axis=0)
    return count, mean, variance, low, high
