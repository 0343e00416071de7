"""A sweep: any models on any data, paired by repeat, resumable, and read by `compare`."""

import errno
import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import offbeat as ob
from offbeat.cli.app import main
from offbeat.models.zoo import train_config
from offbeat.sweeps.engines import local
from offbeat.sweeps.engines.base import Ending, Engine, attempt
from offbeat.sweeps.fingerprint import random_walks
from offbeat.sweeps.record import Record

DATA = random_walks(24, 30, 2)
SPLIT = ob.SplitConfig(window=12, observed_fraction=0.5, seed=3)
SIZE = {"hidden_size": 4, "field_units": (8,), "decoder_units": (8,)}
MODELS = {
    "gru": ob.ModelConfig("gru", **SIZE),
    "wide": ob.ModelConfig("gru", **{**SIZE, "hidden_size": 6}),
    "ode": ob.ModelConfig("ode_rnn", **SIZE),
}
OPTIONS = {"repeats": 3, "split": SPLIT, "epochs": 2, "processes": 1, "progress": False}


def numbers(folder):
    """All that must be the same however a record came about: no wall time, no date."""
    record, left_out = Record.read(folder), ("seconds", "finished_at")
    rows = [*record.runs.values(), *(line for lines in record.curves.values() for line in lines)]
    return [{k: repr(v) for k, v in row.items() if k not in left_out} for row in rows]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return ob.sweep(DATA, MODELS, out=tmp_path_factory.mktemp("sweep") / "out", **OPTIONS)


def test_a_run_has_the_scores_of_the_same_model_trained_by_hand(done):
    split = replace(SPLIT, seed=SPLIT.seed + 1)
    train, validation, test = ob.apply_split(DATA, split)
    model = ob.make_model(MODELS["ode"], train, seed=split.seed)
    config = train_config("ode_rnn", epochs=2, keep="best", seed=split.seed)
    ob.fit(model, train, validation, config, progress=False)
    scores = ob.evaluate({"ode": model}, test, seed=split.seed).scores
    row = done.record.runs["ode-r01"]
    for name in ("after_first_observation", "masked", "after_first_row", "published"):
        assert row[f"{name}_mse"] == getattr(scores["ode"], name).mse
        assert row[f"last_value_{name}_mse"] == getattr(scores["last_value"], name).mse


def test_the_models_of_a_repeat_share_windows_masks_and_split_and_repeats_do_not(done):
    rows = list(done.record.runs.values())
    assert len(rows) == 9
    drawn = {}
    for row in rows:
        key = (
            row["seed_draw"],
            row["last_value_masked_mse"],
            row["last_value_after_first_row_mse"],
        )
        drawn.setdefault(row["repeat"], set()).add(key)
    assert [len(keys) for keys in drawn.values()] == [1, 1, 1]
    assert len(set.union(*drawn.values())) == 3


def test_compare_reads_the_folder_and_pairs_by_repeat(done, capsys):
    comparison = done.compare(baseline="last_value", resamples=200)
    (condition,) = comparison.conditions
    assert condition.repeats == ("repeat 0", "repeat 1", "repeat 2")
    means = {summary.model: summary.mean for summary in condition.summaries}
    rows = [r for r in done.record.runs.values() if r["model"] == "wide"]
    assert means["wide"] == np.mean([r["after_first_observation_mse"] ** 0.5 for r in rows])
    trivial = [r["last_value_after_first_observation_mse"] ** 0.5 for r in rows]
    assert means["last_value"] == np.mean(trivial)
    assert main(["compare", str(done.folder), "--resamples", "200", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {row["model"] for row in said["conditions"][0]["summaries"]} == {*MODELS, "last_value"}


def test_a_sweep_can_be_continued_with_more_models_and_repeats(done, tmp_path):
    out = tmp_path / "out"
    first = ob.sweep(DATA, {"gru": MODELS["gru"]}, out=out, **{**OPTIONS, "repeats": 2})
    assert list(first.record.runs) == ["gru-r00", "gru-r01"]
    ob.sweep(DATA, MODELS, out=out, **OPTIONS)
    assert numbers(out) == numbers(done.folder)
    kept = ob.sweep(DATA, {"ode": MODELS["ode"]}, out=out, **OPTIONS)
    assert len(kept.record.runs) == 9  # those of models that were not asked for stay


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"split": replace(SPLIT, window=11)}, "another sweep: split"),
        ({"scaler": "min_max"}, r"another sweep: scaler \('standardise' then, 'min_max' now\)"),
        ({"epochs": 3}, "another sweep: model gru"),
        ({"dataset": random_walks(24, 31, 2)}, "a sweep of other trajectories"),
        ({"models": ["gru", "gru"]}, "labels that differ, got gru, gru"),
        ({"models": {"a/b": "gru"}}, "'a/b' names a folder"),
        ({"training": {"grru": ob.TrainConfig()}}, "did you mean 'gru'"),
        ({"repeats": 0}, "repeats must be an integer from 1 to 100, got 0"),
        ({"engine": "loocal"}, "did you mean 'local'"),
    ],
)
def test_another_sweep_in_the_same_folder_and_bad_options_are_refused(done, changes, said):
    options = {"dataset": DATA, "models": MODELS, "out": done.folder, **OPTIONS, **changes}
    if "engine" in changes:
        options["repeats"] = 4
    before = numbers(done.folder)
    with pytest.raises(ob.InputError, match=said):
        ob.sweep(**options)
    assert numbers(done.folder) == before


SCRIPT = """
import sys
import offbeat as ob
from offbeat.sweeps.fingerprint import random_walks
if __name__ == "__main__":
    ob.sweep(random_walks(24, 30, 2), ["gru", "ode_rnn"], out=sys.argv[1], repeats=2, epochs=30,
             split=ob.SplitConfig(window=12, observed_fraction=0.5), processes=2)
"""


@pytest.mark.slow
def test_a_sweep_killed_twice_and_resumed_ends_with_the_same_numbers(tmp_path):
    script, killed, whole = tmp_path / "script.py", tmp_path / "killed", tmp_path / "whole"
    script.write_text(SCRIPT, encoding="utf-8")

    def epochs():
        # No walk through the folders: checkpoints come and go while it would run.
        logs = (killed / "runs").glob("*/training/log.csv")
        return sum(max(0, log.read_text(encoding="utf-8").count("\n") - 1) for log in logs)

    for least in (3, 40):
        process = subprocess.Popen([sys.executable, script, killed], stderr=subprocess.PIPE)
        try:
            end = time.monotonic() + 240
            while epochs() < least and process.poll() is None and time.monotonic() < end:
                time.sleep(0.02)
            assert process.poll() is None, process.stderr.read()
            assert len(Record.read(killed).runs) < 4
        finally:
            process.kill()
            process.communicate()
    for folder in (killed, whole):
        subprocess.run([sys.executable, script, folder], check=True, capture_output=True)
    assert len(Record.read(whole).runs) == 4
    assert numbers(killed) == numbers(whole)
    assert len(json.loads((killed / "sessions.json").read_text(encoding="utf-8"))) == 3


def test_the_local_engine_leaves_room_within_the_limits_of_the_container(monkeypatch):
    monkeypatch.setattr(local, "available_cores", lambda: 64)
    monkeypatch.setattr(local, "available_memory", lambda: 9 * 2**30)
    assert local.LocalEngine(None, 1).capacity == 4  # of 2 GiB each
    monkeypatch.setattr(local, "available_memory", lambda: None)
    assert local.LocalEngine(None, 2).capacity == 32


def test_the_command_sweeps_and_prints_the_comparison(tmp_path, capsys):
    log, out = tmp_path / "walks.parquet", tmp_path / "out"
    ob.save(DATA, log)
    options = ["--repeats=3", "--processes=1", "--training.epochs=1", "--split.window=12"]
    command = ["sweep", str(log), str(out), "--models", "gru,rnn", *options]
    assert main([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["runs"], said["missing"]) == (6, [])
    (condition,) = said["comparison"]["conditions"]
    assert [(pair["first"], pair["second"]) for pair in condition["pairs"]] == [("gru", "rnn")]
    assert main(command) == 0  # all is done: the record is read
    assert "paired t p" in capsys.readouterr().out


def test_a_job_on_a_full_disk_fails_with_the_file_and_what_to_do():
    class Job:
        name = "gru-0"

        def perform(self):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "runs/gru-0/log.csv")

    failure = attempt(Job())
    assert failure is not None
    assert failure.message == (
        f"gru-0: runs/gru-0/log.csv can't be written: {os.strerror(errno.ENOSPC)}; free some "
        "space, then repeat the command"
    )


class Here(Engine):
    """Runs jobs in this process."""

    capacity, description = 1, "this process"

    def submit(self, job):
        self.job = job

    def wait(self, seconds):
        return [Ending(self.job, attempt(self.job))]

    def stop(self):
        pass


def test_a_record_whose_writing_takes_long_is_written_seldom_and_whole_at_the_end(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("offbeat.sweeps.running.engine_named", lambda *_, **__: Here())
    writes, write = [], Record.write

    def slow(self, folder):
        writes.append(len(self.runs))
        time.sleep(0.3)
        write(self, folder)

    monkeypatch.setattr(Record, "write", slow)
    model = {"gru": MODELS["gru"]}
    found = ob.sweep(DATA, model, out=tmp_path, **{**OPTIONS, "epochs": 1, "repeats": 4})
    assert writes[0] == 0
    assert writes[-1] == 4
    assert len(writes) < 6
    assert Record.read(tmp_path).runs == found.record.runs
    assert len(found.record.runs) == 4
