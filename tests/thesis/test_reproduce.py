"""The record of an experiment: complete, each run once, the same numbers whatever happens."""

import errno
import json
import os
import shutil
import signal
from dataclasses import asdict, replace

import pytest
import torch
from experiment_helpers import (
    LONG,
    ONLY,
    SMALL,
    InThisProcess,
    numbers,
    script,
    start,
    wait_until,
)

import offbeat as ob
from offbeat import kernels
from offbeat.sweeps import running as command
from offbeat.sweeps import session
from offbeat.sweeps import task as execution
from offbeat.sweeps.progress import seconds_left
from thesis.__main__ import main
from thesis.fingerprint import fingerprint
from thesis.protocol import MODELS, Protocol, select
from thesis.publish import publish
from thesis.record import CURVE_COLUMNS, RUN_COLUMNS, SCORINGS, Record
from thesis.reproduce import ThesisPlan, reproduce


@pytest.fixture
def here(monkeypatch):
    """Runs happen in this process; what was asked for is kept."""
    engine = InThisProcess()
    monkeypatch.setattr(command, "engine_named", lambda name, **options: engine)
    return engine


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The small protocol, done in this process without a disturbance."""
    out = tmp_path_factory.mktemp("small") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "engine_named", lambda name, **options: InThisProcess())
        reproduce(SMALL, out, progress=False)
    return out


@pytest.fixture(scope="module")
def long_record(tmp_path_factory):
    """Two longer runs, done in this process without a disturbance."""
    out = tmp_path_factory.mktemp("long") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "engine_named", lambda name, **options: InThisProcess())
        return reproduce(LONG, out, only=ONLY, progress=False).record


def copied(done, tmp_path):
    return shutil.copytree(done, tmp_path / "out")


# --- what is left on disk -------------------------------------------------------------------------


def test_every_run_of_the_protocol_is_in_the_record_once_with_its_curve(done):
    record = Record.read(done)
    assert list(record.runs) == [run.run_id for run in SMALL.runs()]
    for run in SMALL.runs():
        row = record.runs[run.run_id]
        assert {k: row[k] for k in asdict(run)} == asdict(run)
        assert row["steps"] == run.epochs  # 17 trajectories, one batch
        assert [line["epoch"] for line in record.curves[run.run_id]] == list(
            range(1, run.epochs + 1)
        )
        last = record.curves[run.run_id][-1]
        assert row["validation_published_mse"] == last["validation_published_mse"]


def test_the_parquet_files_and_the_csv_files_hold_the_same(done, tmp_path):
    for name in ("record.csv", "curves.csv"):
        shutil.copy(done / name, tmp_path)
    assert Record.read(tmp_path) == Record.read(done)


def test_the_columns_of_the_tables_are_as_documented(done):
    for name, columns in (("record", RUN_COLUMNS), ("curves", CURVE_COLUMNS)):
        header = (done / f"{name}.csv").read_text(encoding="utf-8").splitlines()[0]
        assert header.split(",") == list(columns)


def test_a_run_is_a_folder_with_config_log_scores_and_a_model_that_scores_as_recorded(done):
    run = SMALL.runs()[3]
    folder = done / "runs" / run.run_id
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert config["run"]["seed_weights"] == run.seed_weights
    assert config["training"]["seed"] == run.seed_draw
    assert (folder / "training" / "log.csv").is_file()
    model = ob.load_model(folder / "training")
    recorded = SMALL.simulate(progress=False)
    _, _, test = SMALL.cut(recorded, run)
    scores = ob.evaluate(model, test, seed=run.seed_draw).scores
    row = Record.read(done).runs[run.run_id]
    for name, score in SCORINGS.items():
        assert getattr(scores[run.model], score).mse == row[f"{name}_mse"]
        assert getattr(scores["last_value"], score).mse == row[f"last_value_{name}_mse"]
    assert model.scaler.to_dict() == ob.Scaler.fit("divide_by_max", recorded).to_dict()


def test_published_and_rows_1_99_differ_by_the_constant_of_the_hidden_first_rows(done):
    rows = Record.read(done).runs.values()
    for row in rows:
        constant = row["row_0_constant"] * row["hidden_rows_0_share"]
        expected = (11 * row["rows_1_99_mse"] + constant) / 12
        assert row["published_mse"] == pytest.approx(expected, rel=1e-6)
    assert any(row["hidden_rows_0_share"] > 0 for row in rows)


def test_the_models_of_a_repeat_are_scored_on_the_same_values(done):
    rows = [r for r in Record.read(done).runs.values() if r["experiment"] == 2]
    for repeat in (0, 1):
        same = {
            (r["last_value_published_mse"], r["last_value_honest_mse"], r["row_0_constant"])
            for r in rows
            if r["repeat"] == repeat
        }
        assert len(same) == 1
    assert len({r["last_value_honest_mse"] for r in rows}) == 2


# --- going on -------------------------------------------------------------------------------------


def test_a_record_that_is_complete_is_left_as_it_is(done, tmp_path, here):
    out = copied(done, tmp_path)
    before = (out / "record.csv").read_bytes()
    result = reproduce(SMALL, out, progress=False)
    assert here.given == []
    assert result.missing == ()
    assert (out / "record.csv").read_bytes() == before


def test_runs_that_finished_before_the_record_was_written_are_not_done_again(done, tmp_path, here):
    out = copied(done, tmp_path)
    for name in ("record.parquet", "record.csv", "curves.parquet", "curves.csv"):
        (out / name).unlink()
    assert reproduce(SMALL, out, progress=False).record == Record.read(done)
    assert here.given == []


def test_a_record_of_another_folder_is_gone_on_from(done, tmp_path, here):
    committed = tmp_path / "results"
    whole = Record.read(done)
    lost = [run.run_id for run in SMALL.runs()[2:4]]
    whole.without(lost).write(committed)
    (committed / "record.parquet").unlink()  # the CSV is enough
    (committed / "curves.parquet").unlink()
    result = reproduce(SMALL, tmp_path / "out", record=committed, progress=False)
    assert here.given == lost
    assert numbers(result.record) == numbers(whole)


def test_a_filter_leaves_the_other_runs_for_later(done, tmp_path, here):
    out = tmp_path / "out"
    first = reproduce(SMALL, out, only="experiment=1", progress=False)
    assert set(first.record.runs) == set(here.given)
    assert all(name.startswith("e1-") for name in here.given)
    whole = reproduce(SMALL, out, progress=False)
    assert len(here.given) == len(set(here.given)) == len(SMALL.runs())
    assert numbers(whole.record) == numbers(Record.read(done))


def test_a_full_disk_loses_nothing(done, tmp_path, here, monkeypatch):
    out = tmp_path / "out"
    writes = iter(range(1000))

    def write_json(path, value, real=execution.write_json):
        if next(writes) == 7:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        real(path, value)

    with monkeypatch.context() as patch:
        patch.setattr(execution, "write_json", write_json)
        with pytest.raises(ob.OffbeatError, match=r"No space left.*the same command resumes"):
            reproduce(SMALL, out, progress=False)
    assert len(Record.read(out).runs) == 3  # each run writes config and scores
    assert numbers(reproduce(SMALL, out, progress=False).record) == numbers(Record.read(done))


def test_a_disk_that_fills_while_the_record_is_written_loses_nothing(
    done, tmp_path, here, monkeypatch
):
    out = tmp_path / "out"
    writes = iter(range(1000))

    def write(self, folder, real=Record.write):
        if next(writes) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(folder))
        real(self, folder)

    with monkeypatch.context() as patch:
        patch.setattr(session, "WAITS", 0.0)  # the record is written after every run
        patch.setattr(Record, "write", write)
        with pytest.raises(OSError, match="No space left"):
            reproduce(SMALL, out, progress=False)
    assert len(Record.read(out).runs) == 2
    before = len(here.given)
    assert numbers(reproduce(SMALL, out, progress=False).record) == numbers(Record.read(done))
    assert len(here.given) == before + len(SMALL.runs()) - 3


def test_a_checkpoint_that_a_power_cut_damaged_is_begun_again(done, tmp_path, here):
    out = copied(done, tmp_path)
    run = SMALL.runs()[2]
    for name in ("record.parquet", "record.csv"):
        (out / name).unlink()
    folder = out / "runs" / run.run_id
    (folder / "scores.json").unlink()
    for tensors in (folder / "training" / "checkpoints").rglob("*.safetensors"):
        tensors.write_bytes(b"")
    assert numbers(reproduce(SMALL, out, progress=False).record) == numbers(Record.read(done))
    assert here.given == [run.run_id]


def test_time_that_is_over_stops_the_experiment_and_the_rest_is_done_later(
    done, tmp_path, here, monkeypatch
):
    out = tmp_path / "out"
    assert reproduce(SMALL, out, budget_minutes=0, progress=False).record == Record.empty()
    clock = iter(range(100_000))
    with monkeypatch.context() as patch:
        patch.setattr(session.time, "monotonic", lambda: float(next(clock)))
        first = reproduce(SMALL, out, budget_minutes=1, progress=False)
    assert 0 < len(first.record.runs) < len(SMALL.runs())
    assert "resumes" in str(first)
    whole = reproduce(SMALL, out, progress=False)
    assert numbers(whole.record) == numbers(Record.read(done))
    assert len(set(here.given)) == len(SMALL.runs())


def test_a_run_that_diverges_does_not_stop_the_others(tmp_path, here):
    wild = replace(SMALL, learning_rate=1e30, repeats=1)
    with pytest.raises(ob.DivergenceError, match="of the runs diverged"):
        reproduce(wild, tmp_path / "out", progress=False)
    record = Record.read(tmp_path / "out")
    assert "e2-anchored_ode_gru_d-50-r00" in record.runs  # it has a learning rate of its own
    status = json.loads((tmp_path / "out" / "status.json").read_text(encoding="utf-8"))
    assert len(status["diverged"]) + len(record.runs) == len(wild.runs())


# --- never mixed in silence -----------------------------------------------------------------------


def other_machine(done, folder, names, **changes):
    """A record some of whose runs were made elsewhere."""
    record = Record.read(done)
    for name in names:
        record = record.with_run({**record.runs[name], **changes}, record.curves[name])
    record.in_order(record.runs).write(folder)


@pytest.mark.parametrize(
    "changes",
    [{"bits": "0" * 12}, {"cpu": "Another CPU"}, {"kernel_body": "generic"}, {"data": "0" * 12}],
)
def test_runs_made_otherwise_are_refused_with_what_differs(done, tmp_path, here, changes):
    names = [run.run_id for run in SMALL.runs()[:2]]
    other_machine(done, tmp_path / "results", names, **changes)
    ((column, value),) = changes.items()
    with pytest.raises(ob.InputError, match=f"2 runs with {column} {value} "):
        reproduce(SMALL, tmp_path / "out", record=tmp_path / "results", progress=False)


def test_another_commit_of_the_same_code_is_not_another_group(done, tmp_path, here):
    other_machine(done, tmp_path / "results", [SMALL.runs()[0].run_id], commit="abcdef")
    result = reproduce(SMALL, tmp_path / "out", record=tmp_path / "results", progress=False)
    assert result.record.runs[SMALL.runs()[0].run_id]["commit"] == "abcdef"
    assert here.given == []


def test_mixed_runs_are_accepted_aloud_and_stay_marked(done, tmp_path, here, capsys):
    names = [run.run_id for run in SMALL.runs()[:2]]
    other_machine(done, tmp_path / "results", names, cpu="Another CPU")
    result = reproduce(SMALL, tmp_path / "out", record=tmp_path / "results", mixed="accept")
    assert "the record is mixed, 2 runs with cpu Another CPU" in capsys.readouterr().err
    assert here.given == []
    marked = [n for n, row in result.record.runs.items() if row["cpu"] == "Another CPU"]
    assert marked == names
    assert Record.read(tmp_path / "out").groups() == result.record.groups()


def test_mixed_runs_are_done_again_on_request(done, tmp_path, here):
    out = copied(done, tmp_path)
    names = [run.run_id for run in SMALL.runs()[:2]]
    other_machine(done, out, names, cpu="Another CPU", honest_mse=1.0)
    result = reproduce(SMALL, out, mixed="redo", progress=False)
    assert here.given == names
    assert numbers(result.record) == numbers(Record.read(done))


@pytest.mark.slow
def test_a_run_that_other_code_began_is_begun_again(long_record, tmp_path, here):
    out = tmp_path / "out"
    process = start(script(LONG, out, only=ONLY, processes=1))
    name = "e1-gru-50-r00"
    log = out / "runs" / name / "training" / "log.csv"
    wait_until(lambda: log.exists() and log.read_text().count("\n") > 3, process=process)
    process.kill()
    process.communicate()
    config = out / "runs" / name / "config.json"
    with config.with_name(".lock").open() as lock:  # its process ends with the killed one
        wait_until(lambda: free(lock))
    kept = json.loads(config.read_text(encoding="utf-8"))
    kept["provenance"]["bits"] = "0" * 12
    config.write_text(json.dumps(kept), encoding="utf-8")
    relic = log.with_name("relic")
    relic.touch()
    result = reproduce(LONG, out, only=ONLY, progress=False)
    assert numbers(result.record) == numbers(long_record)
    now = json.loads(config.read_text(encoding="utf-8"))
    assert now["provenance"]["bits"] == fingerprint()
    assert now["seconds_before"] == 0.0
    assert not relic.exists()


def free(lock) -> bool:
    import fcntl

    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    fcntl.flock(lock, fcntl.LOCK_UN)
    return True


def test_a_fingerprint_depends_on_arithmetic_alone(monkeypatch):
    few = {label: MODELS[label] for label in ("gru_d", "anchored_ode_gru_d")}
    monkeypatch.setattr("thesis.fingerprint.MODELS", few)
    own = fingerprint.__wrapped__()
    before = torch.get_num_threads()
    torch.set_num_threads(2)  # threads change no bit
    try:
        assert fingerprint.__wrapped__() == own
    finally:
        torch.set_num_threads(before)
    other = replace(Protocol(), anchored_learning_rate=0.003)
    assert fingerprint.__wrapped__(other) != own
    if kernels.cpu.instruction_sets():
        with kernels.use("reference"):
            assert fingerprint.__wrapped__() != own


# --- bad input ------------------------------------------------------------------------------------


def test_a_folder_of_another_protocol_is_refused(done, tmp_path, here):
    out = copied(done, tmp_path)
    with pytest.raises(ob.InputError, match=r"another protocol: repeats \(2 then, 1 now\)"):
        reproduce(replace(SMALL, repeats=1), out, progress=False)


def test_a_record_of_another_protocol_is_refused_although_its_runs_have_the_same_names(
    done, tmp_path, here
):
    longer = replace(SMALL, epochs_of_curves=4)
    with pytest.raises(ob.InputError, match=r"of another protocol \(epochs 3, expected 4"):
        reproduce(longer, tmp_path / "out", record=done, progress=False)


def test_a_record_that_is_not_there_is_an_error(tmp_path, here):
    with pytest.raises(ob.InputError, match="holds no record"):
        reproduce(SMALL, tmp_path / "out", record=tmp_path, progress=False)


def test_a_damaged_record_says_what_to_do(done, tmp_path, here):
    out = copied(done, tmp_path)
    (out / "record.parquet").write_bytes((out / "record.parquet").read_bytes()[:-100])
    with pytest.raises(ob.FileFormatError, match=r"record.parquet cannot be read .*remove it"):
        reproduce(SMALL, out, progress=False)
    (out / "record.parquet").unlink()
    assert reproduce(SMALL, out, progress=False).record == Record.read(done)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"engine": "loocal"}, "did you mean 'local'"),
        ({"mixed": "never"}, "expected one of: accept, redo, refuse"),
        ({"processes": 0}, "processes must be at least 1"),
        ({"threads": 0}, "threads must be at least 1"),
        ({"budget_minutes": -1.0}, "budget_minutes must be at least 0"),
        ({"engine_options": {"address": "x"}}, "the local engine has no options, got address"),
    ],
)
def test_bad_options_are_refused_in_one_line(tmp_path, options, said):
    with pytest.raises(ob.InputError, match=said):
        reproduce(SMALL, tmp_path / "out", progress=False, **options)


# --- how far it is --------------------------------------------------------------------------------


def test_the_time_left_follows_from_what_an_epoch_of_each_model_has_cost():
    runs = Protocol().runs()
    gru, ode = select(runs, "experiment=2,model=gru,model=ode_rnn,fraction=0.3,repeat=0")
    rows = [
        {"model": "gru", "seconds": 50.0, "epochs": 50},
        {"model": "ode_rnn", "seconds": 500.0, "epochs": 50},
    ]
    assert seconds_left([gru], {ode: 20}, [], capacity=2) is None
    # 50 epochs of 1 s and 30 of 10 s: on one process 350 s, on two as long as the longer one.
    assert seconds_left([gru], {ode: 20}, rows, capacity=1) == 350
    assert seconds_left([gru], {ode: 20}, rows, capacity=2) == 300
    assert seconds_left([gru] * 10, {ode: 20}, rows, capacity=2) == 400
    # A model that has not run costs what epochs cost on average: 5.5 s.
    (fair,) = select(runs, "experiment=2,model=gru_fair,fraction=0.3,repeat=0")
    assert seconds_left([fair], {}, rows, capacity=2) == 275


def test_the_status_file_and_the_sessions_say_what_was_done(done):
    status = json.loads((done / "status.json").read_text(encoding="utf-8"))
    assert status["runs_done"] == status["runs_total"] == len(SMALL.runs())
    assert status["running"] == []
    (session,) = json.loads((done / "sessions.json").read_text(encoding="utf-8"))
    assert session["runs"] == [run.run_id for run in SMALL.runs()]
    spent = sum(row["seconds"] for row in Record.read(done).runs.values())
    assert spent <= session["seconds"] + 0.1


# --- what is committed ----------------------------------------------------------------------------


def test_what_is_published_can_be_gone_on_from_and_keeps_what_stands_there(done, tmp_path, here):
    half, to = tmp_path / "half", tmp_path / "results"
    reproduce(SMALL, half, only="experiment=1", progress=False)
    publish(half, to, SMALL, command=["offbeat", "reproduce"])
    kept = sorted(path.name for path in (to / "models").iterdir())
    assert kept == ["e1-ode_gru_d-50-r00", "e1-ode_rnn-50-r00"]
    other = tmp_path / "other"
    reproduce(SMALL, other, record=to, progress=False)
    publish(other, to, SMALL, command=["offbeat", "reproduce", "--budget_minutes", "5"])
    assert numbers(Record.read(to)) == numbers(Record.read(done))
    assert sorted(path.name for path in (to / "models").iterdir()) == kept
    about = json.loads((to / "about.json").read_text(encoding="utf-8"))
    assert about["runs_done"] == about["runs_total"] == len(SMALL.runs())
    assert len(about["sessions"]) == 2
    assert about["commands"] == [["offbeat", "reproduce"]]  # a time limit changes no number
    assert sum(group["runs"] for group in about["made_by"]) == len(SMALL.runs())
    assert ob.load_model(to / "models" / kept[0]).config.name == "ode_gru_d"


@pytest.mark.slow
def test_the_command_reproduces_a_part_of_the_tiny_protocol(tmp_path, capsys):
    out, to = tmp_path / "out", tmp_path / "results"
    options = ["--only", "experiment=1,model=gru,fraction=0.9", "--processes=1"]
    assert main(["run", f"--out={out}", "--tiny", *options, f"--publish={to}", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["runs_asked"] == 1
    assert said["runs_missing"] == []
    assert list(Record.read(to).runs) == ["e1-gru-90-r00"]


# --- killed ---------------------------------------------------------------------------------------


def epochs_of(out, name) -> int:
    log = out / "runs" / name / "training" / "log.csv"
    return max(0, log.read_text(encoding="utf-8").count("\n") - 1) if log.exists() else 0


def worker_of(out, name) -> int:
    return int((out / "runs" / name / ".lock").read_text(encoding="utf-8"))


def kill_a_worker(out, process, name):
    """Ends, without a warning, the process that is in the middle of a run."""
    wait_until(lambda: epochs_of(out, name) > 3, process=process)
    pid = worker_of(out, name)
    assert pid != process.pid
    os.kill(pid, signal.SIGKILL)
    killed_at = epochs_of(out, name)
    assert 3 < killed_at < LONG.epochs_of_curves
    return pid


def check_nothing_lost_and_nothing_twice(out, process, expected):
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    record = Record.read(out)
    assert numbers(record) == numbers(expected)
    finished = [line for line in said.splitlines() if "test RMSE" in line]
    assert len(finished) == len(expected.runs), said
    (session,) = json.loads((out / "sessions.json").read_text(encoding="utf-8"))
    assert sorted(session["runs"]) == sorted(expected.runs)
    return said


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray", "slurm"])
def test_a_worker_that_is_killed_costs_nothing_but_time(engine, long_record, tmp_path):
    out = tmp_path / "out"
    process = start(script(LONG, out, only=ONLY, engine=engine, processes=2))
    try:
        name = "e1-ode_gru_d-50-r00"
        kill_a_worker(out, process, name)
        said = check_nothing_lost_and_nothing_twice(out, process, long_record)
    finally:
        process.kill()
        process.wait()
    assert f"the process of {name} was killed" in said


def test_two_experiments_in_one_folder_are_refused(tmp_path):
    out = tmp_path / "out"
    process = start(script(LONG, out, only=ONLY, processes=1))
    try:
        wait_until(lambda: (out / "status.json").exists(), process=process)
        with pytest.raises(ob.InputError, match="another process uses"):
            reproduce(LONG, out, progress=False)
    finally:
        process.kill()
        process.communicate()


def test_a_finished_run_is_left_alone(done, tmp_path):
    out = copied(done, tmp_path)
    run = SMALL.runs()[0]
    record = json.loads((out / "data" / "recorded.json").read_text(encoding="utf-8"))
    recorded = out / "data" / "recorded.parquet"
    task = execution.Task(
        run, ThesisPlan(SMALL), recorded, record["fingerprint"], out / "runs" / run.run_id
    )
    before = (task.folder / "scores.json").stat().st_mtime_ns
    task.perform()
    assert (task.folder / "scores.json").stat().st_mtime_ns == before
    strange = replace(task, fingerprint="0" * 64, folder=tmp_path / "other")
    with pytest.raises(ob.FileFormatError, match="does not hold the trajectories"):
        strange.perform()
