"""JSON lines: every line is answered, bad ones too, and nothing that was read is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_helpers import small_model, trajectory
from stream_helpers import Recorded, batch_predictions, message

from offbeat import Stream, load_model, save_model
from offbeat.cli.app import main
from offbeat.stream.latency import Latency
from offbeat.stream.lines import LineSession
from offbeat.stream.pipes import LONGEST_LINE, serve


def ask(session: LineSession, line: Any) -> Any:
    answer = session.answer(line if isinstance(line, bytes) else json.dumps(line).encode())
    assert answer.endswith(b"\n")
    assert answer.count(b"\n") == 1
    return json.loads(answer)


# --- what is said ---------------------------------------------------------------------------------


def test_each_new_row_is_predicted_before_its_values_are_used() -> None:
    model, one = small_model("anchored_ode_gru_d"), trajectory(4, 12)
    session = LineSession(Stream(model))
    expected = batch_predictions(model, one)
    for row in range(one.rows):
        said = ask(session, {"t": one.times[row], "values": message(one, row)})
        assert (said["t"], said["outcome"]) == (one.times[row], "new")
        got = [said["prediction"][name] for name in one.names]
        np.testing.assert_allclose(got, expected[row], rtol=0, atol=1e-12)


def test_with_a_horizon_the_time_after_the_newest_row_is_predicted() -> None:
    model, one = small_model("gru_d"), trajectory(4, 5)
    session, stream = LineSession(Stream(model), horizon_s=0.25), Stream(model)
    for row in range(one.rows):
        said = ask(session, {"t": one.times[row], "values": message(one, row)})
        stream.observe(one.times[row], message(one, row))
        assert said["at"] == pytest.approx(one.times[row] + 0.25, abs=1e-12)
        assert list(said["prediction"].values()) == stream.predict(said["at"]).tolist()
    late = ask(session, {"t": one.times[-2], "values": {}})
    assert late["outcome"] == "late"
    assert late["prediction"] == said["prediction"]


def test_nanoseconds_go_through_json_to_the_last_digit() -> None:
    stream = Recorded(time_unit="ns", stale_after_s=1.0)
    session, start = LineSession(stream, horizon_s=0.5), 1_700_000_000_123_456_789
    said = ask(session, {"t": start, "values": {"a": 1}, "now": start + 5})
    assert (said["t"], said["at"]) == (start, start + 500_000_000)
    assert ask(session, {"t": start + 1, "values": {}, "now": start + 2 * 10**9})["outcome"] == (
        "stale"
    )


def test_what_is_not_a_new_row_has_no_prediction_of_its_own() -> None:
    session = LineSession(Recorded())
    rows = [(1.0, [1, None, None]), (1.0, [None, 2, None]), (0.5, [1, 1, 1]), (-50.0, [1, 1, 1])]
    said = [ask(session, {"t": t, "values": values}) for t, values in rows]
    assert [s["outcome"] for s in said] == ["new", "merged", "late", "pending"]
    assert [s["prediction"] is None for s in said] == [False, True, True, True]


def test_it_predicts_resets_counts_records_and_restores() -> None:
    session = LineSession(Recorded())
    ask(session, {"t": 1, "values": {"a": 1.0}})
    assert ask(session, {"predict": 2}) == {"predict": 2, "prediction": {"a": 1, "b": 1, "c": 1}}
    several = ask(session, {"predict": [2, 2.5]})
    assert several == {"predict": [2, 2.5], "prediction": {name: [1, 1] for name in "abc"}}
    state = ask(session, {"state": True})["state"]
    ask(session, {"t": 2, "values": {"a": 1.0}})
    assert ask(session, {"predict": 2})["prediction"]["a"] == 2
    assert ask(session, {"restore": state}) == {"restored": True}
    assert ask(session, {"predict": 2})["prediction"]["a"] == 1
    assert ask(session, {"reset": True}) == {"reset": True}
    assert ask(session, {"predict": 2})["prediction"]["a"] == 0
    assert ask(session, {"counters": True})["counters"] == session.stream.counters.to_dict() | {
        "pending": 0
    }


@pytest.mark.parametrize(
    "line",
    [
        b"hello",
        b'{"t": 1',
        b"\xff\xfe",
        b"[1, 2]",
        b"3",
        b"{}",
        b'{"t": 1}',
        b'{"t": 1, "values": {}, "valeus": 3}',
        b'{"t": "1", "values": {}}',
        b'{"t": 1, "values": {"x": 1}}',
        b'{"t": 1, "values": {"a": "1"}}',
        b'{"t": 1, "values": {"a": [1]}}',
        b'{"t": 1, "values": "abc"}',
        b'{"t": 1, "values": [1, 2]}',
        b'{"t": 1, "values": {}, "now": "x"}',
        b'{"t": NaN, "values": {}}',
        b'{"t": 1e999, "values": {}}',
        b'{"predict": null}',
        b'{"predict": {"t": 1}}',
        b'{"predict": -3}',
        b'{"reset": 1}',
        b'{"restore": {}}',
        b"[" * 100_000,
        b'{"t": 1' + b"0" * 5000 + b', "values": {}}',
    ],
)
def test_a_bad_line_is_reported_and_changes_nothing(line: bytes) -> None:
    session = LineSession(Recorded())
    ask(session, {"t": 0.0, "values": {"a": 1.0}})
    before = session.stream.state()
    answer = ask(session, line)
    assert answer.keys() == {"error", "line"}
    assert answer["line"] == 2
    assert (session.lines, session.bad_lines) == (2, 1)
    assert session.stream.state() == before


def test_blank_lines_are_counted_and_not_answered() -> None:
    session = LineSession(Recorded())
    assert session.answer(b"") == session.answer(b" \r") == b""
    assert ask(session, b"x")["line"] == 3


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abct"), inner),
    max_leaves=8,
)
KEYS = st.sampled_from(["t", "values", "now", "predict", "reset", "state", "counters", "restore"])


@given(
    st.lists(
        st.binary(max_size=40)
        | st.dictionaries(KEYS, JSON_VALUES, max_size=3).map(lambda d: json.dumps(d).encode())
        | st.tuples(JSON_VALUES, JSON_VALUES).map(
            lambda pair: json.dumps({"t": pair[0], "values": pair[1]}).encode()
        ),
        max_size=12,
    )
)
def test_any_line_is_answered_with_strict_json(lines: list[bytes]) -> None:
    session = LineSession(Recorded())

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    for line in lines:
        answer = session.answer(line.replace(b"\n", b""))
        if answer:
            json.loads(answer, parse_constant=refuse)


# --- through pipes --------------------------------------------------------------------------------


def piped(data: bytes, *, chunk: int = 1 << 16) -> tuple[list[Any], LineSession]:
    """Serves what is written to a pipe in pieces; returns the answers."""
    (source, into), (out, sink) = os.pipe(), os.pipe()
    session, answers = LineSession(Recorded()), b""

    def write() -> None:
        for start in range(0, len(data), chunk):
            os.write(into, data[start : start + chunk])
        os.close(into)

    def run() -> None:
        assert serve(session.answer, session.refuse, source=source, sink=sink)
        os.close(sink)

    threads = [threading.Thread(target=each) for each in (write, run)]
    for thread in threads:
        thread.start()
    while piece := os.read(out, 1 << 16):
        answers += piece
    for thread in threads:
        thread.join()
    for each in (source, out):
        os.close(each)
    return [json.loads(line) for line in answers.splitlines()], session


@pytest.mark.parametrize("chunk", [1, 7, 1 << 16])
def test_lines_may_arrive_in_any_pieces_and_the_last_one_without_its_end(chunk: int) -> None:
    lines = [json.dumps({"t": 0.1 * i, "values": {"a": i}}) for i in range(30)]
    answers, session = piped("\n".join(lines).encode(), chunk=chunk)
    assert [a["t"] for a in answers] == [0.1 * i for i in range(30)]
    assert session.stream.counters.rows == 30


def test_half_a_last_line_is_reported() -> None:
    answers, _ = piped(b'{"t": 1, "values": {}}\r\n\n{"t": 2, "val')
    assert answers[0]["outcome"] == "new"
    assert answers[1]["line"] == 3


@pytest.mark.parametrize("length", [LONGEST_LINE + 1, 3 * LONGEST_LINE])
def test_a_line_without_an_end_fills_no_memory(length: int) -> None:
    good = b'{"t": 1, "values": {}}\n'
    answers, session = piped(good + b"x" * length + b"\n" + good + b"y" * length)
    assert ["error" in a for a in answers] == [False, True, False, True]
    assert (session.lines, session.bad_lines) == (4, 2)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stream") / "model"
    save_model(small_model("gru_d"), path)
    return path


def command(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
    pipe = subprocess.PIPE
    call = [sys.executable, "-W", "error", "-m", "offbeat", "stream", *map(str, arguments)]
    return subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=pipe, **options)


def rows(one: Any, which: range) -> bytes:
    said = ({"t": one.times[i], "values": message(one, i)} for i in which)
    return b"".join(json.dumps(each).encode() + b"\n" for each in said)


def test_the_command_answers_every_line_and_goes_on_where_it_stopped(
    checkpoint: Path, tmp_path: Path
) -> None:
    """Options, statistics; the state is kept in a file between two runs."""
    one, state = trajectory(4, 12), tmp_path / "state.json"
    arguments = (checkpoint, "--state", state, "--stats", "--options.late=reorder")
    answers = []
    for which, extra in ((range(7), b"oops\n"), (range(7, 12), b"")):
        with command(*arguments) as process:
            out, err = process.communicate(rows(one, which) + extra)
        assert process.returncode == 0, err
        answers += [json.loads(line) for line in out.splitlines()]
    assert "error" in answers.pop(7)
    got = [list(a["prediction"].values()) for a in answers]
    np.testing.assert_allclose(
        got, batch_predictions(load_model(checkpoint), one), rtol=0, atol=1e-12
    )
    stats = json.loads(err)
    assert (stats["lines"], stats["bad_lines"], stats["answers_heard_to_the_end"]) == (5, 0, True)
    assert stats["counters"]["rows"] == 12
    latency = stats["latency"]
    assert latency["count"] == 5 == sum(each["count"] for each in latency["histogram"])
    assert 0 < latency["median_us"] <= latency["p999_us"] <= latency["longest_us"]
    assert json.loads(state.read_text())["counters"]["rows"] == 12


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_after_everything_that_had_arrived_was_answered(
    checkpoint: Path, tmp_path: Path, number: int
) -> None:
    one, state = trajectory(4, 40), tmp_path / "state.json"
    with command(checkpoint, "--state", state, "--stats") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write(rows(one, range(1)))
        process.stdin.flush()
        first = process.stdout.readline()  # it is up, and waits for more
        assert b'"new"' in first
        process.stdin.write(rows(one, range(1, 40)) + b'{"predict": 9')
        process.stdin.flush()
        process.send_signal(number)
        out, err = process.stdout.read(), process.stderr.read()  # its input stays open
        assert process.wait(timeout=60) == 0, err
        answers = [json.loads(line) for line in out.splitlines()]
    # The last line had arrived in part: it has no answer.
    assert [a.get("t") for a in answers] == one.times[1:].tolist()
    assert json.loads(err)["bad_lines"] == 0
    assert json.loads(err)["counters"]["rows"] == 40
    assert json.loads(state.read_text())["counters"]["rows"] == 40


def test_a_reader_that_goes_away_ends_it_quietly(checkpoint: Path, tmp_path: Path) -> None:
    one, state = trajectory(4, 200), tmp_path / "state.json"
    with command(checkpoint, "--state", state) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write(rows(one, range(2)))
        process.stdin.flush()
        assert process.stdout.readline()
        assert process.stdout.readline()
        process.stdout.close()
        process.stdin.write(rows(one, range(2, 3)))
        process.stdin.flush()
        assert process.wait(timeout=60) == 0
        assert process.stderr.read() == b""
    # The row was consumed, although the answer was not read.
    assert json.loads(state.read_text())["counters"]["rows"] == 3


def test_what_the_command_cannot_start_with_is_one_line_of_error(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, other = tmp_path / "damaged.json", tmp_path / "other.json"
    damaged.write_text("{")
    other.write_text("{}")
    for arguments in (
        [tmp_path / "none"],
        [tmp_path / "none.onnx"],
        [checkpoint, "--state", damaged],
        [checkpoint, "--state", other],
        [checkpoint, "--state", tmp_path],
        [checkpoint, "--horizon_s=-1"],
        [checkpoint, "--time_unit=h"],
        [checkpoint, "--options.late=never"],
        [checkpoint, "--seed=-1"],
    ):
        assert main(["stream", *map(str, arguments)]) == 2, arguments
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


# --- latency --------------------------------------------------------------------------------------


def test_quantiles_of_latencies_are_upper_bounds_within_five_percent() -> None:
    random = np.random.default_rng(0)
    durations = np.exp(random.normal(10, 2, 20_000)).astype(int) + 1
    latency = Latency()
    for duration in durations.tolist():
        latency.add(duration)
    for fraction in (0.001, 0.5, 0.99, 0.999, 1.0):
        exact = np.quantile(durations, fraction, method="inverted_cdf") / 1000
        if exact > 0.1:  # the first bin ends here
            assert exact <= latency.quantile_us(fraction) * (1 + 1e-12) <= 1.048 * exact
    assert latency.to_dict()["longest_us"] == durations.max() / 1000


def test_latencies_beyond_all_bins_are_kept() -> None:
    latency = Latency()
    assert latency.quantile_us(0.5) is None
    for duration in (0, 50, 10**11):
        latency.add(duration)
    said = latency.to_dict()
    assert said["histogram"] == [
        {"up_to_us": 0.1, "count": 2}, {"up_to_us": 1e8, "count": 1},
    ]  # fmt: skip
    assert (said["median_us"], said["p999_us"]) == (0.1, 1e8)


def test_a_signal_handler_is_put_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    source, into = os.pipe()
    os.write(into, b"x\n")
    os.close(into)
    began = time.monotonic()
    with open(os.devnull, "wb") as nowhere:
        assert serve(lambda line: b"", lambda why: b"", source=source, sink=nowhere.fileno())
    os.close(source)
    assert time.monotonic() - began < 10
    assert signal.getsignal(signal.SIGTERM) is before
