"""`offbeat train` on a folder that need not fit in memory, and `offbeat sweep --together`."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import yaml

import offbeat as ob
from offbeat.cli.app import main
from offbeat.config import SplitConfig
from offbeat.data import converted, memory
from offbeat.data.masking import masked_values
from offbeat.data.shards import ShardedDataset, save_shards
from offbeat.errors import FileFormatError, InputError
from offbeat.learning_shards import learn_shards
from offbeat.sweeps import sweep

SMALL = ["--model.name=gru", "--training.epochs=1", "--baselines=[last_value]"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Eight files of two trajectories of 60 rows."""
    out = tmp_path_factory.mktemp("walks")
    data = ob.simulate("hopper", 16, 60, seed=1, progress=False)
    assert len(save_shards(iter(data), out, rows=120)) == 8
    return out


def error_of(capsys, *arguments) -> str:
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_folder_of_data_sets_is_read_as_one(folder, tmp_path):
    data = ob.read(folder)
    assert len(data) == 16
    files = sorted(folder.glob("*.parquet"))
    for one, two in zip(data, [t for path in files for t in ob.load(path)], strict=True):
        assert np.array_equal(one.values, two.values)
    assert len(ob.read(files[2:4])) == 4
    ob.save(ob.simulate("walker", 1, 5, progress=False), tmp_path / "b.parquet")
    with pytest.raises(FileFormatError, match="put files of other channels in another folder"):
        ob.read([files[0], tmp_path / "b.parquet"])


def test_a_folder_larger_than_memory_is_trained_on_file_by_file(
    folder, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(memory, "available_memory", lambda: 300_000)

    def whole(self):
        raise AssertionError("all files were read at once")

    monkeypatch.setattr(ShardedDataset, "whole", whole)
    out = tmp_path / "run"
    split = ["--split.window=20", "--split.observed_fraction=0.5"]
    assert main(["train", str(folder), str(out), *SMALL, *split]) == 0
    said = capsys.readouterr()
    assert "8 files, 960 rows x 14 channels, 0.000152 GB in memory, more than 25%" in said.err
    assert "files are read when they are needed (--lazy=false reads all at once)" in said.err
    assert "6, 1, 1 files train, validate and test; windows of 20 rows" in said.err
    assert "the test part, whose windows are in" in said.out
    assert yaml.safe_load((out / "config.yaml").read_text())["lazy"] is True

    # The test windows are scored alike by another command, and none is of a file for training.
    test = ob.load(out / "test.parquet")
    assert main(["evaluate", str(out), str(out / "test.parquet"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["tasks"] == json.loads((out / "results.json").read_text())["tasks"]
    of = [
        {path.stem for path in folder.glob("*.parquet") for t in ob.load(path) if _within(w, t)}
        for w in test
    ]
    assert all(len(files) == 1 for files in of)
    assert len(set.union(*of)) == 1


def _within(window, trajectory) -> bool:
    at = np.searchsorted(trajectory.times, window.times[0] - 1e-9)
    rows = trajectory.values[at : at + window.rows]
    return rows.shape == window.values.shape and np.array_equal(rows, window.values)


def test_parts_are_whole_files_and_samples_are_masked(folder):
    opened = ob.Dataset.open(folder)
    split = SplitConfig(window=20, observed_fraction=0.25, seed=3)
    config = ob.TrainConfig(epochs=1)
    options = {"baselines": ["last_value"], "progress": False}
    learned = learn_shards(opened, model="gru", training=config, split=split, **options)
    for part in (learned.train, learned.validation, learned.test):
        hidden = np.mean([masked_values(t).mean() for t in part])
        assert 0.6 < hidden < 0.8  # 0.75 of the rows but the first
    assert len(learned.train) == 6 * 2 * 3
    assert len(learned.test) == 2 * 3
    with pytest.raises(InputError, match=r"split\.by needs the data in memory"):
        learn_shards(opened, split=SplitConfig(by="time"))
    with pytest.raises(InputError, match="2 files can't be split"):
        learn_shards(opened.take([0, 1]))
    with pytest.raises(InputError, match="leave none of 4 files"):
        learn_shards(opened.take(range(4)), split=SplitConfig(fractions=(0.1, 0.45, 0.45)))


def test_logs_of_other_programs_are_converted_one_by_one(tmp_path, capsys, monkeypatch):
    logs, out = tmp_path / "logs", tmp_path / "run"
    logs.mkdir()
    data = ob.simulate("hopper", 8, 60, seed=1, progress=False)
    for i, one in enumerate(data):
        ob.save(ob.Dataset((one,)), logs / f"{i}.csv")
    command = ["train", str(logs), str(out), "--lazy", *SMALL, "--split.window=20"]
    command.append("--reader.time_column=time")
    assert main(command) == 0
    assert "8 files, 480 rows x 14 channels" in capsys.readouterr().err
    opened = ob.Dataset.open(out / "converted")
    assert [shard.rows for shard in opened.shards] == [(60,)] * 8
    assert np.allclose(opened.part(3)[0].values, data[3].values)
    assert main(["impute", str(out), str(logs / "3.csv"), str(tmp_path / "filled.csv")]) == 0
    kept = json.loads((out / "reader.json").read_text())
    assert (kept["outliers"], kept["time_column"]) == ("mask", "time")
    assert main(["evaluate", str(out), str(out / "test.parquet")]) == 0  # read without these

    # Files that did not change are not read again; one that did is.
    read_again, same = [], {"time_column": "time", "outliers": "mask"}
    monkeypatch.setattr(converted, "read", lambda path, **_: read_again.append(path) or data)
    converted.convert(logs, out / "converted", **same)
    assert read_again == []
    ob.save(ob.Dataset((data[0],)), logs / "5.csv")
    converted.convert(logs, out / "converted", **same)
    assert read_again == [logs / "5.csv"]
    (logs / "7.csv").unlink()
    converted.convert(logs, out / "converted", **same)
    assert len(ob.Dataset.open(out / "converted").shards) == 7
    monkeypatch.undo()
    (logs / "8.csv").write_text("time,x\n")  # without rows, which leaves it out
    assert len(converted.convert(logs, out / "converted", **same).shards) == 7
    with pytest.raises(InputError, match="holds the logs; give another folder"):
        converted.convert(logs, logs)


def test_what_is_not_read_file_by_file_is_one_line(folder, tmp_path, capsys):
    out = tmp_path / "run"
    file = next(folder.glob("*.parquet"))
    assert "--lazy reads the files of a folder one by one" in error_of(
        capsys, "train", file, out, "--lazy"
    )
    (tmp_path / "none").mkdir()
    assert "holds no files" in error_of(capsys, "train", tmp_path / "none", out, "--lazy")
    options = ["train", tmp_path / "none", out, "--lazy", "--two_sided"]
    assert "--two_sided needs the data in memory" in error_of(capsys, *options)
    options = ["train", folder, out, "--lazy", "--two_sided"]
    assert "--two_sided needs the data in memory" in error_of(capsys, *options)


def test_the_command_sweeps_runs_together(folder, tmp_path, capsys, monkeypatch):
    class StoppedError(Exception):
        pass

    def instead(plan, out, dataset, **options):
        given.update(options, trajectories=len(dataset))
        raise StoppedError

    given: dict[str, Any] = {}
    files = ["sweep", str(folder), str(tmp_path / "sweep"), "--models=gru", "--repeats=2"]
    line = error_of(capsys, *files, "--together=0")
    assert "together must be an integer of at least 1, got 0" in line
    monkeypatch.setattr(sweep, "run_plan", instead)
    with pytest.raises(StoppedError):
        main([*files, "--together=2"])
    assert given["together"] == 2
    assert given["trajectories"] == 16
