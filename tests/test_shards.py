"""Folders of Parquet files: what is read, in which order, and how much of it at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_helpers import dataset, trajectory

import offbeat as ob
from offbeat.data.batch import Batch
from offbeat.data.scaler import Scaler
from offbeat.data.shards import ShardedDataset, save_shards
from offbeat.examples import Examples
from offbeat.models.statistics import Statistics
from offbeat.models.zoo import recipe_of
from offbeat.sharded import ShardedEpoch, ShardedTrainingSet, groups_of


@pytest.fixture(scope="module")
def logs():
    """Trajectories of different lengths, with masks."""
    return tuple(trajectory(i, 7 + (5 * i) % 13) for i in range(24))


@pytest.fixture(scope="module")
def folder(logs, tmp_path_factory):
    """Files of about 30 rows."""
    out = tmp_path_factory.mktemp("shards")
    assert len(save_shards(iter(logs), out, rows=30)) > 6
    return out


def test_an_opened_folder_holds_what_was_saved_and_reads_it_file_by_file(logs, folder):
    opened = ob.Dataset.open(folder)
    assert isinstance(opened, ShardedDataset)
    assert len(opened) == len(logs)
    assert opened.rows == sum(t.rows for t in logs)
    assert opened.names == logs[0].names
    found = [t for part in opened.parts() for t in part]
    for ours, known in zip(found, logs, strict=True):
        assert np.array_equal(ours.times, known.times)
        assert np.array_equal(ours.values, known.values)
        assert np.array_equal(ours.observed, known.observed)


def test_one_pass_measures_what_the_whole_data_set_gives(logs, folder):
    whole, opened = ob.Dataset(logs), ob.Dataset.open(folder)
    for kind in ("standardise", "min_max", "divide_by_max", "identity"):
        model = ob.make_model("gru", opened, scaler=kind, hidden_size=2)
        expected = Scaler.fit(kind, whole)
        assert model.scaler.kind == kind
        assert np.allclose(model.scaler.shift, expected.shift, rtol=1e-12)
        assert np.allclose(model.scaler.scale, expected.scale, rtol=1e-12)
        known = Statistics.of(Batch.of(whole, scaler=expected, dtype=torch.float64))
        for name in ("mean", "std", "low", "high", "longest_elapsed", "longest_delta", "rows"):
            ours = getattr(model.statistics, name)
            assert ours == pytest.approx(getattr(known, name), rel=1e-9, abs=1e-9), name
        # torch takes the lower one of two in the middle
        gaps = np.sort(np.concatenate([np.diff(t.times) for t in logs]))
        assert model.statistics.median_gap == np.median(gaps)


def turns(epoch: ShardedEpoch) -> list[tuple[float, ...]]:
    """The first times of the windows of an epoch, in their order."""
    found = []
    for group in range(len(epoch.groups)):
        examples, order = epoch._group(group)
        assert len(epoch._loaded) <= 2
        batch = examples._drawn.take(order)
        found += [tuple(row.flatten().tolist()) for row in batch.values[:, :3]]
    return found


@pytest.mark.parametrize("cache_mb", [0.001, 100.0])
def test_an_epoch_has_every_window_once_in_an_order_of_seed_and_epoch_alone(folder, cache_mb):
    opened = ob.Dataset.open(folder, window=5, cache_mb=cache_mb)
    model = ob.make_model("gru", opened, hidden_size=2)
    recipe = recipe_of("gru", ob.TrainConfig(seed=4), validated=False)
    training = ShardedTrainingSet(model, opened, recipe)
    first = turns(training.epoch(0))
    assert len(first) == len(training) == sum(max(1, t // 5) for s in opened.shards for t in s.rows)
    assert len(set(first)) == len(first)
    assert turns(training.epoch(0)) == first
    second = turns(training.epoch(1))
    assert second != first
    assert sorted(second) == sorted(first)  # without redraw, the same windows
    other = ShardedTrainingSet(model, opened, replace(recipe, seed=5))
    assert turns(other.epoch(0)) != first
    drawn = ob.TrainConfig(redraw=ob.RedrawConfig((0.5,)))
    fresh = ShardedTrainingSet(model, opened, recipe_of("gru", drawn, validated=False))
    assert sorted(turns(fresh.epoch(0))) != sorted(turns(fresh.epoch(1)))
    groups = groups_of(opened, seed=4, epoch=0)
    assert sorted(i for group in groups for i in group) == list(range(len(opened.shards)))
    assert (len(groups) == 1) == (cache_mb == 100.0)


def test_the_loss_of_all_batches_is_that_of_the_data_set_in_memory(logs, folder):
    opened = ob.Dataset.open(folder, cache_mb=0.002)
    model = ob.make_model("ode_gru_d", opened, hidden_size=3)
    recipe = recipe_of("ode_gru_d", ob.TrainConfig(), validated=False)
    epoch = ShardedTrainingSet(model, opened, recipe).epoch(0)
    assert len(epoch.groups) > 3
    total = count = 0.0
    for first in range(0, len(epoch), 7):  # across the borders of groups
        index = torch.arange(first, min(first + 7, len(epoch)))
        loss, n = epoch.weighed(model, index, None)
        total, count = total + float(loss.detach()) * float(n), count + float(n)
    whole = Examples(model, model.batch(ob.Dataset(logs)))
    expected, n = whole.weighed(model, torch.arange(len(logs)), None)
    assert count == float(n)
    assert total / count == pytest.approx(float(expected.detach()), rel=1e-5)


def test_a_training_that_was_stopped_within_an_epoch_ends_in_the_same_bits(folder, tmp_path):
    opened = ob.Dataset.open(folder, window=5, cache_mb=0.001)
    validation = opened.sample(6, seed=1)
    config = ob.TrainConfig(
        epochs=2,
        batch_size=4,
        redraw=ob.RedrawConfig((0.4, 0.8)),
        loss="relative",
        checkpoint_every=3,
    )

    class KilledError(Exception):
        """Stands for a process that is killed."""

    def trained(out, *, stop=None):
        model = ob.make_model("gru_d", opened, hidden_size=3)
        if stop is not None:
            run, steps = model.run, []

            def counted(*arguments, **options):
                if torch.is_grad_enabled():
                    steps.append(1)
                if len(steps) > stop:
                    raise KilledError
                return run(*arguments, **options)

            model.run = counted
            with pytest.raises(KilledError):
                ob.fit(model, opened, validation, config, out=out, progress=False)
            return None
        result = ob.fit(model, opened, validation, config, out=out, progress=False)
        assert len(result.history) == 2
        return torch.cat([p.detach().reshape(-1) for p in model.parameters()])

    whole = trained(tmp_path / "whole")
    trained(tmp_path / "stopped", stop=8)
    assert torch.equal(trained(tmp_path / "stopped"), whole)
    wider = ob.Dataset.open(folder, window=6, cache_mb=0.001)
    model = ob.make_model("gru_d", opened, hidden_size=3)
    with pytest.raises(ob.InputError, match="holds another run"):
        ob.fit(model, wider, validation, config, out=tmp_path / "stopped", progress=False)


def test_models_with_a_trend_and_parts_of_a_folder(folder):
    opened = ob.Dataset.open(folder, window=6)
    some = opened.take(range(3))
    assert len(some.shards) == 3
    assert len(opened.sample(5)) == 5
    model = ob.make_model("anchored_trend", some, hidden_size=3)
    assert len(model.statistics.filters) == 3
    ob.fit(model, some, config=ob.TrainConfig(epochs=1), progress=False)


def test_what_a_folder_does_not_give_is_one_line(folder, tmp_path):
    opened = ob.Dataset.open(folder, window=5)
    model = ob.make_model("gru", opened, hidden_size=2)
    for message, call in {
        "holds no Parquet files": lambda: ob.Dataset.open(tmp_path),
        "window must be a number of rows": lambda: ob.Dataset.open(folder, window=1),
        "cache_mb must be above 0": lambda: ob.Dataset.open(folder, cache_mb=0),
        "take its parts: for part in data.parts": lambda: ob.predict(model, opened),
        "needs all values in memory": lambda: ob.make_model("gru", opened, scaler="robust"),
        "give redraw instead": lambda: ob.fit(
            model, opened, config=ob.TrainConfig(tasks=ob.TaskConfig(0.1, 0.01))
        ),
        "windows of 4 rows, the folder was opened with windows of 5": lambda: ob.fit(
            model, opened, config=ob.TrainConfig(redraw=ob.RedrawConfig((0.5,), window=4))
        ),
    }.items():
        with pytest.raises(ob.OffbeatError, match=message):
            call()
    save_shards(dataset(2), tmp_path)
    save_shards(dataset(2, channels=2), tmp_path / "other")
    (tmp_path / "other" / "shard-000000.parquet").rename(tmp_path / "z.parquet")
    with pytest.raises(ob.FileFormatError, match=r"z\.parquet has the channels"):
        ob.Dataset.open(tmp_path)
    (tmp_path / "z.parquet").write_bytes(b"nothing")
    with pytest.raises(ob.FileFormatError, match=r"z\.parquet can't be read as Parquet"):
        ob.Dataset.open(tmp_path)
    (tmp_path / "z.parquet").unlink()
    known = ob.Dataset.open(tmp_path)
    before = known.fingerprint()
    save_shards(dataset(3), tmp_path)
    with pytest.raises(ob.FileFormatError, match="was changed after the folder was opened"):
        known.part(0)
    assert ob.Dataset.open(tmp_path).fingerprint() != before
