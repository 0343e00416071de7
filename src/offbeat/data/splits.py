"""From recorded trajectories to what models are trained on: parts, splits, scales."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from offbeat.config import SplitConfig, from_mapping
from offbeat.data.masking import mask_out
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.windows import Cut, owned_windows
from offbeat.data.windows import windows as windows
from offbeat.errors import FileFormatError, InputError, one_of
from offbeat.files import write_json

ScalerKind = Literal["standardise", "min_max", "divide_by_max", "identity"]
SCALERS: tuple[str, ...] = ("standardise", "min_max", "divide_by_max", "identity")


def split(
    dataset: Dataset,
    fractions: Sequence[float] = (0.7, 0.15, 0.15),
    *,
    seed: int = 0,
) -> tuple[Dataset, ...]:
    """Splits by trajectory, so that no trajectory stands in two parts.

    Args:
        dataset: trajectories to share out.
        fractions: one per part; they sum to 1.
        seed: of the shuffle.

    Returns:
        One data set per fraction (training, validation, test by default).

    Raises:
        InputError: fractions are not positive or do not sum to 1, or a part would be empty.
    """
    return tuple(dataset.take(index) for index in _shares(len(dataset), fractions, seed))


def split_in_time(
    dataset: Dataset, fractions: Sequence[float] = (0.7, 0.15, 0.15)
) -> tuple[Dataset, ...]:
    """Splits a log in time: its first rows are the first part, and so on.

    Several trajectories count as one log, one after the other; the one in which a part ends is cut
    there. A single row that is left of it is dropped.

    Args:
        dataset: a log, its trajectories in the order of time.
        fractions: one per part, of the rows; they sum to 1.

    Returns:
        One data set per fraction.

    Raises:
        InputError: fractions are not positive or do not sum to 1, or a part would be empty.
    """
    rows = sum(t.rows for t in dataset)
    ends = _ends(rows, fractions)
    pieces: list[list[Trajectory]] = [[] for _ in ends]
    before = 0
    for trajectory in dataset:
        start = 0
        for part, end in zip(pieces, ends, strict=True):
            stop = min(max(int(end) - before, start), trajectory.rows)
            if stop - start >= 2:
                part.append(trajectory.slice(start, stop))
            start = stop
        before += trajectory.rows
    if not all(pieces):
        raise InputError(
            f"{rows} rows are too few to be split in time into {list(fractions)}: a part would be "
            "empty; use a longer log or fewer parts"
        )
    return tuple(replace(dataset, trajectories=tuple(part)) for part in pieces)


def apply_split(dataset: Dataset, config: SplitConfig) -> tuple[Dataset, Dataset, Dataset]:
    """Windows, hiding and split, all from one seed.

    By trajectory, all windows of a trajectory stand in one part. In time, the log is split before
    all else, so that no window straddles. Where each trajectory gives one window, cells are hidden
    in the windows; where it gives several, they are hidden before it is cut, so that shares hold
    for the trajectory, or for its part in time. `random` windows are for training: validation and
    test are cut consecutively, so that each of their rows counts once.

    Args:
        dataset: as recorded.
        config: what to do.

    Returns:
        Training, validation and test part.

    Raises:
        InputError: as `windows`, `mask_out`, `split` and `split_in_time`.
    """
    if config.split == "in_time":
        in_time = split_in_time(dataset, config.fractions)
        dataset = replace(dataset, trajectories=tuple(t for part in in_time for t in part))
        ends = np.cumsum([len(part) for part in in_time])
        shares = np.split(np.arange(len(dataset)), ends[:-1])
    else:
        shares = _shares(len(dataset), config.fractions, config.seed)
    cut: Cut = config.cut or ("consecutive" if config.split == "in_time" else "one")
    owners = np.arange(len(dataset))
    if config.observed_fraction is not None and cut != "one":
        dataset = mask_out(dataset, seed=config.seed, **config.hiding)
    if config.window is not None or config.window_s is not None:
        validation_set: Cut = "consecutive" if cut == "random" else cut
        dataset, owners = owned_windows(
            dataset,
            config.window,
            seconds=config.window_s,
            cuts=[cut if i in shares[0] else validation_set for i in range(len(dataset))],
            count=config.window_count,
            seed=config.seed,
        )
    if config.observed_fraction is not None and cut == "one":
        dataset = mask_out(dataset, seed=config.seed, **config.hiding)
    train, validation, test = (
        dataset.take(np.flatnonzero(np.isin(owners, index))) for index in shares
    )
    return train, validation, test


def _shares(count: int, fractions: Sequence[float], seed: int) -> list[NDArray[np.int64]]:
    """Positions of the trajectories of each part."""
    ends = _ends(count, fractions)
    starts = np.concatenate([[0], ends[:-1]])
    if (ends <= starts).any():
        raise InputError(
            f"{count} trajectories are too few for the fractions {list(fractions)}: a part "
            "would be empty; use more trajectories or fewer parts, or split a long log in time "
            "(split='in_time')"
        )
    order = np.random.default_rng(seed).permutation(count)
    return [np.sort(order[start:end]) for start, end in zip(starts, ends, strict=True)]


def _ends(count: int, fractions: Sequence[float]) -> NDArray[np.int64]:
    shares = np.asarray(fractions, dtype=float)
    if shares.ndim != 1 or not (shares > 0).all() or not abs(shares.sum() - 1) <= 1e-9:
        raise InputError(f"fractions must be positive and sum to 1, got {list(fractions)}")
    return np.floor(np.cumsum(shares) * count + 0.5).astype(np.int64)


def save_split(path: str | Path, config: SplitConfig, dataset: Dataset) -> None:
    """Writes down how a data set was cut, so that `load_split` can cut it so again.

    Args:
        path: JSON file to write.
        config: as given to `apply_split`.
        dataset: as given to `apply_split`.
    """
    write_json(path, {**asdict(config), "data": dataset.fingerprint()})


def load_split(path: str | Path, dataset: Dataset) -> tuple[Dataset, Dataset, Dataset] | None:
    """Cuts a data set as it was cut before: training, validation and test part.

    Args:
        path: JSON file that `save_split` wrote.
        dataset: as recorded.

    Returns:
        The three parts, or None if the file is missing or was written for other data.

    Raises:
        FileFormatError: the file is damaged.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        same = kept.pop("data") == dataset.fingerprint()
        return apply_split(dataset, from_mapping(SplitConfig, kept)) if same else None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path} is damaged ({error}); train again") from None


@dataclass(frozen=True, eq=False)
class Scaler:
    """An affine map per channel: scaled = (value - shift) / scale.

    Fitted on the training part and saved with the model. `divide_by_max` is the thesis'
    normalisation, kept for comparability by this name: `(x - min) / max`, which is not the range.

    Args:
        kind: `standardise`, `min_max`, `divide_by_max` or `identity`.
        shift: (channels,) in the channels' units.
        scale: (channels,) in the channels' units, not zero.
    """

    kind: str
    shift: NDArray[np.float64]
    scale: NDArray[np.float64]

    def __post_init__(self) -> None:
        one_of("scaler", self.kind, SCALERS)
        shift = np.asarray(self.shift, dtype=np.float64)
        scale = np.asarray(self.scale, dtype=np.float64)
        if shift.ndim != 1 or shift.shape != scale.shape:
            raise InputError(f"shift and scale need one shape, got {shift.shape}, {scale.shape}")
        if not (np.isfinite(shift).all() and np.isfinite(scale).all() and (scale != 0).all()):
            raise InputError("shift and scale must be finite, and scale not zero")
        object.__setattr__(self, "shift", shift)
        object.__setattr__(self, "scale", scale)

    @classmethod
    def identity(cls, channels: int) -> Scaler:
        """Leaves values as they are."""
        return cls("identity", np.zeros(channels), np.ones(channels))

    @classmethod
    def fit(cls, kind: str, dataset: Dataset) -> Scaler:
        """Measures a scale on the observed cells of a data set, per channel.

        Args:
            kind: `standardise` (mean, standard deviation), `min_max` (minimum, range),
                `divide_by_max` (minimum, maximum) or `identity`.
            dataset: the training part.

        Raises:
            InputError: a channel is never observed, or its maximum is 0 under `divide_by_max`.
        """
        one_of("scaler", kind, SCALERS)
        count, mean, square, low, high = _moments(dataset)
        check_observed(dataset.names, count, len(dataset))
        if kind == "identity":
            return cls.identity(dataset.channels)
        if kind == "standardise":
            deviation = np.sqrt(square)
            # A channel that never moves carries no information; leave its size alone.
            return cls(kind, mean, np.where(deviation > 1e-12 * np.abs(mean), deviation, 1.0))
        if kind == "min_max":
            return cls(kind, low, np.where(high > low, high - low, 1.0))
        if (high == 0).any():
            name = dataset.names[int((high == 0).argmax())]
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
        """JSON-like form; floats survive to the last bit."""
        return {"kind": self.kind, "shift": self.shift.tolist(), "scale": self.scale.tolist()}

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Scaler:
        """The inverse of `to_dict`."""
        return cls(value["kind"], np.array(value["shift"]), np.array(value["scale"]))


def check_observed(names: Sequence[str], count: NDArray[np.int64], trajectories: int) -> None:
    """Raises InputError when a channel has no observed cell at all."""
    if (count == 0).any():
        never = [name for name, n in zip(names, count, strict=True) if n == 0]
        raise InputError(
            f"never observed in {trajectories} training trajectories: {', '.join(never)}; leave "
            "such channels out, nothing can be learned about them"
        )


def _moments(dataset: Dataset) -> tuple[NDArray[Any], ...]:
    """Count, mean, variance, minimum and maximum of the observed cells, per channel."""
    values = np.concatenate([t.values for t in dataset])
    observed = np.concatenate([t.observed for t in dataset])
    count = observed.sum(axis=0)
    safe = np.maximum(count, 1)
    mean = np.where(observed, values, 0).sum(axis=0) / safe
    variance = (np.where(observed, values - mean, 0) ** 2).sum(axis=0) / safe
    low = np.where(observed, values, np.inf).min(axis=0)
    high = np.where(observed, values, -np.inf).max(axis=0)
    return count, mean, variance, low, high
