"""`learn` for a folder of Parquet files that need not fit in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.config import ModelConfig, RedrawConfig, SplitConfig, TrainConfig
from offbeat.data.masking import mask_out
from offbeat.data.shards import ShardedDataset
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.learning import Learned, tasks_of, train_blend

WINDOW = 100
"""Rows of a window by default, where trajectories are longer."""

SAMPLED = 512
"""Windows of each part that baselines, weights, intervals and scores are computed from, at most."""

_NOT_HERE = tuple(
    name
    for name in SplitConfig.__dataclass_fields__
    if name not in ("window", "observed_fraction", "mask", "fractions", "seed")
)


def learn_shards(
    dataset: ShardedDataset,
    out: str | Path | None = None,
    *,
    model: str | ModelConfig | None = None,
    training: TrainConfig | None = None,
    split: SplitConfig | None = None,
    horizon_s: float | None = None,
    **options: Any,
) -> Learned:
    """Trains a model on a folder that is read file by file, and blends it with baselines.

    Whole files train, validate or test. The model is trained on all windows of the first part.
    Baselines, weights, intervals and scores are those of at most `SAMPLED` windows of each part.
    With `split.observed_fraction`, values are masked anew in each epoch (see `RedrawConfig`), and
    once in the samples.

    Args:
        dataset: from `Dataset.open`; its window is replaced by that of `split`.
        out: as of `learn`.
        model: as of `learn`; by default `anchored_ode_gru_d`.
        training: as of `learn`.
        split: window, observed_fraction, mask, fractions of the files, and seed.
        horizon_s: as of `learn`.
        **options: baselines, scaler, seed, device and progress, as of `learn`.

    Returns:
        As `learn`; its parts are the samples.

    Raises:
        InputError: there are fewer than three files, an option needs the data in memory, or as of
            `learn`.
    """
    split = split or SplitConfig()
    for name in _NOT_HERE:
        if getattr(split, name) != getattr(SplitConfig(), name):
            raise InputError(
                f"split.{name} needs the data in memory; a folder that is read file by file is "
                "split by files, in windows of split.window rows"
            )
    if split.mask != "rows" and split.mask != "values":
        raise InputError(f"mask {split.mask!r} needs the data in memory, expected rows or values")
    if split.window is None:
        longest = max(max(shard.rows) for shard in dataset.shards)
        split = replace(split, window=min(WINDOW, longest))
    parts = _split(replace(dataset, window=split.window), split)
    samples = [_sampled(part, split, i) for i, part in enumerate(parts)]
    config = training or TrainConfig(seed=split.seed)
    if split.observed_fraction is not None and config.redraw is None:
        config = replace(config, redraw=RedrawConfig((split.observed_fraction,), mask=split.mask))  # type: ignore[arg-type]
    train, validation, test = samples
    blend, fitted, said = train_blend(
        train,
        validation,
        tasks_of(None, train, horizon_s),
        out=out,
        model=model,
        training=config,
        as_it_is=True,
        two_sided=False,
        shards=parts[0],
        **options,
    )
    notes = (
        f"{', '.join(str(len(part.shards)) for part in parts)} files train, validate and test; "
        f"windows of {split.window} rows; baselines, intervals and scores are those of "
        f"{', '.join(str(len(sample)) for sample in samples)} windows",
        *said,
    )
    return Learned(blend, train, validation, test, split, fitted, None, notes)


def _split(dataset: ShardedDataset, split: SplitConfig) -> tuple[ShardedDataset, ...]:
    """Whole files for training, validation and test, drawn by the seed."""
    count = len(dataset.shards)
    if count < 3:
        raise InputError(
            f"{count} files can't be split into training, validation and test; write at least "
            "three, see save_shards"
        )
    validate, test = (max(1, round(f * count)) for f in split.fractions[1:])
    if validate + test >= count:
        raise InputError(
            f"fractions {split.fractions} leave none of {count} files to train on; write more "
            "files, see save_shards"
        )
    order = np.random.default_rng(split.seed).permutation(count)
    ends = count - validate - test, count - test
    return tuple(dataset.take(np.sort(part)) for part in np.split(order, ends))


def _sampled(part: ShardedDataset, split: SplitConfig, number: int) -> Dataset:
    sample = part.sample(SAMPLED, seed=split.seed)
    if split.observed_fraction is None:
        return sample
    return mask_out(sample, split.observed_fraction, mask=split.mask, seed=3 * split.seed + number)
