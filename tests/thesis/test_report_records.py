"""The record of a reproduction is read, checked and asked; what stands beside it is told."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import record_helpers as made

from offbeat.errors import FileFormatError, InputError
from thesis.protocol import Protocol
from thesis.report import circumstances
from thesis.report.circumstances import Circumstances
from thesis.report.records import Record, read_record


@pytest.fixture(scope="module")
def record():
    return made.synthetic(repeats=3, epochs=6, fractions=(0.9, 0.3))


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_record_is_read_as_it_was_written(record, tmp_path, suffix):
    read = read_record(made.write(record, tmp_path / "runs", suffix=suffix))
    for name, values in record.runs.items():
        np.testing.assert_array_equal(read.runs[name], values)
    order = np.lexsort((read.curves["epoch"], read.curves["run_id"].astype(str)))
    expected = np.lexsort((record.curves["epoch"], record.curves["run_id"].astype(str)))
    for name, values in record.curves.items():
        np.testing.assert_array_equal(read.curves[name][order], values[expected])


def test_a_commit_of_digits_alone_stays_a_commit(record, tmp_path):
    read = read_record(made.write(record, tmp_path / "runs", suffix=".csv"))
    assert set(read.runs["commit"]) == {"1234567"}
    assert set(read.runs["bits"]) == {"0e12345"}


def test_runs_are_found_by_what_they_are_in_the_order_of_the_repeats(record):
    shuffled = np.random.default_rng(0).permutation(len(record))
    mixed_up = Record(
        {name: values[shuffled] for name, values in record.runs.items()}, record.curves
    )
    rows = mixed_up.where(experiment=2, model="ode_rnn", fraction=0.3)
    assert mixed_up.values("run_id", rows).tolist() == [f"e2-ode_rnn-30-r0{i}" for i in range(3)]
    np.testing.assert_allclose(
        mixed_up.rmse("honest", rows) ** 2, mixed_up.values("honest_mse", rows)
    )


def test_models_share_the_repeats_that_both_have(record):
    gone = record.runs["run_id"] == "e2-ode_rnn-30-r01"
    rows = made.without(record, gone).shared(("ode_rnn", "gru"), fraction=0.3)
    part = made.without(record, gone)
    for model in ("ode_rnn", "gru"):
        assert part.values("repeat", rows[model]).tolist() == [0, 2]
        assert set(part.values("model", rows[model])) == {model}


def test_a_curve_is_in_the_order_of_its_epochs(record):
    curve = record.curve("e1-gru-90-r00")
    assert curve["epoch"].tolist() == [1, 2, 3, 4, 5, 6]
    assert len(record.curve("no such run")["epoch"]) == 0


def test_curves_of_a_run_that_is_not_recorded_are_left_out(record):
    gone = record.runs["run_id"] == "e1-gru-90-r00"
    assert len(made.without(record, gone).curve("e1-gru-90-r00")["epoch"]) == 0


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("honest_mse", np.nan, r"honest_mse of run 'e1-gru-90-r00' is nan"),
        ("published_mse", np.inf, "published_mse of run"),
        ("seconds", -1.0, "expected a finite number of at least 0"),
        ("hidden_rows_0_share", 1.5, "expected from 0 to 1"),
        ("observed_fraction", 0.0, "observed_fraction of run"),
    ],
)
def test_a_number_out_of_its_range_is_named_with_its_run(record, column, value, said):
    with pytest.raises(InputError, match=said):
        made.changed(record, 0, **{column: value})


def test_a_run_without_hidden_rows_has_no_hidden_score(record):
    kept = made.changed(record, 0, honest_hidden_mse=np.nan)
    assert np.isnan(kept.runs["honest_hidden_mse"][0])


def test_a_run_that_stands_twice_is_refused(record):
    with pytest.raises(InputError, match="two runs with the same run_id"):
        made.changed(record, 1, run_id=record.runs["run_id"][0])
    with pytest.raises(InputError, match="same experiment, model, observed_fraction, repeat"):
        made.changed(record, 1, model=record.runs["model"][0])


def test_a_record_without_runs_is_refused(record):
    with pytest.raises(InputError, match="holds no finished run"):
        made.without(record, np.ones(len(record), bool))


def test_what_is_not_a_record_is_told_what_one_is(tmp_path):
    with pytest.raises(FileFormatError, match="not there; give the folder"):
        read_record(tmp_path / "nowhere")
    with pytest.raises(FileFormatError, match=r"neither record\.parquet nor record\.csv"):
        read_record(tmp_path)
    (tmp_path / "record.parquet").write_bytes(b"no table")
    with pytest.raises(FileFormatError, match=r"record\.parquet"):
        read_record(tmp_path)


def test_a_record_of_other_columns_names_those_that_it_lacks(record, tmp_path):
    folder = made.write(record, tmp_path / "runs", suffix=".csv")
    text = (folder / "record.csv").read_text(encoding="utf-8")
    (folder / "record.csv").write_text(text.replace("honest_mse", "mse"), encoding="utf-8")
    with pytest.raises(FileFormatError, match="honest_mse"):
        read_record(folder)


# --- what stands beside it ------------------------------------------------------------------------


def test_runs_that_were_made_alike_need_no_word(record):
    assert circumstances.mixing(record) == ()
    assert record.mixed(np.arange(len(record))) == ()


def test_runs_of_two_processors_are_told_with_their_numbers(record):
    mixed = made.changed(record, slice(0, 5), cpu="Another one")
    (said,) = circumstances.mixing(mixed)
    assert "processor" in said
    assert f"A processor: {len(record) - 5}; Another one: 5" in said
    assert mixed.mixed(np.arange(10)) == ("cpu",)
    assert mixed.mixed(np.arange(5)) == ()


def test_commits_that_change_no_number_are_told_and_not_marked(record):
    mixed = made.changed(record, 0, commit="89abcde")
    said = circumstances.mixing(mixed)
    assert "commit" in said[0]
    assert "the code is the same" in said[1]
    assert mixed.mixed(np.arange(10)) == ()


def test_models_that_did_not_see_the_same_test_part_are_told(record):
    assert circumstances.broken_pairs(record) == ()
    at = int(np.flatnonzero(record.runs["run_id"] == "e2-gru-30-r02")[0])
    score = 1.01 * record.runs["last_value_honest_mse"][at]
    (said,) = circumstances.broken_pairs(made.changed(record, at, last_value_honest_mse=score))
    assert "repeat 2" in said
    assert "not valid" in said


def test_wall_time_counts_what_overlaps_once_and_pauses_not_at_all(record):
    few = made.without(record, np.arange(len(record)) >= 3)
    times = ("2026-01-01T10:00:00+00:00", "2026-01-01T10:30:00+00:00", "2026-01-03T00:00:00+00:00")
    # 9:00-10:00 and 9:45-10:30 make 1.5 h; a day later 0.5 h.
    timed = made.changed(few, slice(None), finished_at=times, seconds=(3600.0, 2700.0, 1800.0))
    assert circumstances.wall_hours(timed) == pytest.approx(2.0, abs=1e-9)
    assert circumstances.wall_hours(made.changed(few, 0, finished_at="soon")) is None


def test_the_folder_tells_repeats_and_sessions(tmp_path):
    (tmp_path / "protocol.json").write_text(json.dumps({"repeats": 3}))
    sessions = [{"seconds": 60.0, "engine": "2 processes"}, {"seconds": 30, "engine": "ray"}]
    (tmp_path / "sessions.json").write_text(json.dumps(sessions))
    told = Circumstances.of(tmp_path)
    assert (told.repeats, told.sessions_s, told.engines) == (3, 90.0, ("2 processes", "ray"))


def test_a_published_record_tells_the_same_and_its_commands(tmp_path):
    about = {
        "protocol": {"repeats": 4},
        "sessions": [{"seconds": 5.0, "engine": "local"}],
        "commands": [["offbeat", "reproduce", "--tiny"]],
        "here": {"cores": 2, "platform": "Linux", "packages": {"scipy": "1.17.1"}},
    }
    (tmp_path / "about.json").write_text(json.dumps(about))
    told = Circumstances.of(tmp_path)
    assert (told.repeats, told.sessions_s) == (4, 5.0)
    assert told.commands == ("offbeat reproduce --tiny",)
    assert dict(told.machine) == {"platform": "Linux", "cores": "2", "scipy": "1.17.1"}


@pytest.mark.parametrize(
    "text", ["", "[1]", '"x"', "{", '{"sessions": 3, "here": [], "commands": 1}']
)
def test_a_damaged_file_beside_the_record_is_left_out(tmp_path, text):
    for name in ("protocol.json", "sessions.json", "about.json"):
        (tmp_path / name).write_text(text)
    told = Circumstances.of(tmp_path)
    assert (told.repeats, told.sessions_s, told.commands, told.machine) == (10, None, (), ())


@pytest.mark.parametrize(
    ("seconds", "said"), [(59, "59 s"), (3600, "60 min"), (7200, "2.0 h"), (30_960, "8.6 h")]
)
def test_times_are_said_as_people_say_them(seconds, said):
    assert circumstances.hours(seconds) == said


def test_another_protocol_than_the_thesis_is_told_with_what_differs():
    def told(protocol):
        return Circumstances(json.loads(json.dumps(asdict(protocol)))).departures

    assert told(Protocol()) == ()
    assert Circumstances().departures == ()
    (said,) = told(Protocol.tiny())
    assert said.startswith("This is not the thesis' protocol")
    assert "repeats 3 in place of 10" in said
    assert "hidden_size" not in said
