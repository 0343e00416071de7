"""What is done with messages that are not simply the next row, seen in the rows consumed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stream_helpers import NAMES, Recorded

from offbeat import DivergenceError, InputError


def said(stream: Recorded, *messages: tuple[float, dict[str, float]]) -> list[str]:
    return [stream.observe(t, values) for t, values in messages]


# --- messages of one time -------------------------------------------------------------------------


def test_messages_of_equal_times_are_one_row_however_they_arrive() -> None:
    stream = Recorded()
    assert said(stream, (5.0, {"a": 1.0}), (5.5, {"c": 3.0}), (5.5, {"a": 1.0}), (5.5, {"b": 2.0}),
                (6.0, {"a": 4.0})) == ["new", "new", "merged", "merged", "new"]  # fmt: skip
    assert stream.rows == [
        (0.0, (1.0, None, None)), (0.5, (1.0, 2.0, 3.0)), (1.0, (4.0, None, None)),
    ]  # fmt: skip
    assert stream.counted == {
        "messages": 5, "rows": 3, "merged": 2, "longest_gap_s": 0.5,
    }  # fmt: skip


def test_times_within_the_tolerance_are_one_row_at_the_time_of_the_first() -> None:
    stream = Recorded(merge_within_s=0.002)
    outcomes = said(stream, (1.0, {"a": 1.0}), (1.001, {"b": 2.0}), (0.999, {"c": 3.0}),
                    (1.003, {"a": 9.0}), (1.0015, {"a": 9.0}))  # fmt: skip
    assert outcomes == ["new", "merged", "merged", "new", "duplicate"]
    assert stream.rows == [(0.0, (1.0, 2.0, 3.0)), (pytest.approx(0.003), (9.0, None, None))]
    assert stream.predict(1.002)[0] == 2.0, "a time within the tolerance is that of the newest row"
    with pytest.raises(InputError):
        stream.predict(1.0009)


@pytest.mark.parametrize(
    ("options", "stands"),
    [({}, 7.0), ({"duplicates": "last"}, 7.0), ({"duplicates": "first"}, 1.0)],
)
def test_a_value_that_comes_twice_is_taken_once(options: dict[str, Any], stands: float) -> None:
    """The last one by default, as `read` does."""
    stream = Recorded(**options)
    stream.observe(0.0, {"a": 0.0})
    stream.observe(1.0, {"a": 1.0})
    outcomes = [stream.observe(1.0, {"a": 1.0}), stream.observe(1.0, {"a": 7.0, "b": 2.0})]
    assert outcomes == ["duplicate", "merged"]
    assert stream.rows[-1] == (1.0, (stands, 2.0, None))
    assert stream.counted == {
        "messages": 4, "rows": 2, "merged": 1, "duplicates": 2, "longest_gap_s": 1.0,
    }  # fmt: skip


def test_a_value_that_comes_twice_may_be_an_error() -> None:
    stream = Recorded(duplicates="error")
    stream.observe(0.0, {"a": 1.0})
    stream.observe(0.0, {"b": 2.0})
    with pytest.raises(InputError):
        stream.observe(0.0, {"a": 1.0, "b": 2.0, "c": 3.0})
    assert stream.rows == [(0.0, (1.0, 2.0, None))]
    assert stream.counters.messages == 2


def test_a_message_with_nothing_measured_is_a_row_as_in_the_batch_pass() -> None:
    stream = Recorded()
    assert said(stream, (0.0, {"a": 1.0}), (0.5, {}), (0.5, {}), (0.5, {"b": 1.0})) == [
        "new", "new", "duplicate", "merged",
    ]  # fmt: skip
    assert stream.rows[-1] == (0.5, (None, 1.0, None))
    assert stream.counters.empty == 2
    assert stream.counters.longest_gap_s == 0.0, "a gap ends with a value"


# --- late ones ------------------------------------------------------------------------------------


def test_late_messages_are_dropped_and_counted() -> None:
    stream = Recorded()
    assert said(stream, (1.0, {"a": 1.0}), (2.0, {"a": 2.0}), (1.5, {"b": 3.0})) == [
        "new", "new", "late",
    ]  # fmt: skip
    assert len(stream.rows) == 2
    assert stream.counters.late == 1


def test_late_messages_may_be_errors() -> None:
    stream = Recorded(late="error")
    said(stream, (1.0, {"a": 1.0}), (2.0, {"a": 2.0}))
    with pytest.raises(InputError):
        stream.observe(1.5, {"b": 3.0})
    assert stream.counters.messages == 2


def test_late_messages_are_put_where_they_belong() -> None:
    stream = Recorded(late="reorder", jump_back_s=10.0, duplicates="first")
    outcomes = said(stream, (1.0, {"a": 1.0}), (2.0, {"a": 2.0}), (3.0, {"a": 3.0}),
                    (1.5, {"b": 4.0}), (0.5, {"b": 5.0}), (2.0, {"b": 6.0}), (2.0, {"a": 0.0}),
                    (4.0, {"a": 7.0}))  # fmt: skip
    assert outcomes == ["new"] * 3 + ["reordered"] * 2 + ["merged", "duplicate", "new"]
    assert stream.rows == [
        (-0.5, (None, 5.0, None)), (0.0, (1.0, None, None)), (0.5, (None, 4.0, None)),
        (1.0, (2.0, 6.0, None)), (2.0, (3.0, None, None)), (3.0, (7.0, None, None)),
    ]  # fmt: skip
    assert stream.counters.rows == 6
    assert stream.counters.reordered == 2


def test_what_is_older_than_the_kept_rows_is_dropped() -> None:
    stream = Recorded(late="reorder", reorder_rows=2, jump_back_s=10.0)
    said(stream, (1.0, {"a": 1.0}), (2.0, {"a": 2.0}), (3.0, {"a": 3.0}))
    # The row of 1.0 fell out: what comes after it can be placed, it and what is before it cannot.
    assert said(stream, (1.0, {"b": 0.0}), (0.5, {"b": 0.0}), (1.5, {"b": 4.0})) == [
        "late", "late", "reordered",
    ]  # fmt: skip
    assert [time for time, _ in stream.rows] == [0.0, 0.5, 1.0, 2.0]
    assert said(stream, (1.75, {"c": 1.0}), (1.2, {"c": 1.0})) == ["reordered", "late"]


def test_an_engine_that_refuses_a_row_in_the_middle_leaves_everything_as_it_was() -> None:
    stream = Recorded(late="reorder", duplicates="last")
    said(stream, (1.0, {"a": 1.0}), (1.2, {"a": 2.0}), (1.4, {"a": 3.0}))
    before, state = stream.rows, stream.state()
    for t in (1.1, 1.2, 1.4, 1.6):
        with pytest.raises(ArithmeticError):
            stream.observe(t, {"a": 666.0})
        assert stream.rows == before
        assert stream.state() == state
    assert said(stream, (1.1, {"b": 1.0}), (1.2, {"b": 1.0}), (1.5, {"b": 1.0})) == [
        "reordered", "merged", "new",
    ]  # fmt: skip


@st.composite
def arrivals(draw: Any) -> list[tuple[int, dict[str, float], int]]:
    """Cells of a table, in an order in which none is overtaken by rows more than 5 ticks later."""
    cells = draw(
        st.lists(
            st.tuples(st.integers(0, 40), st.sampled_from(NAMES)), min_size=1, max_size=40,
            unique=True,
        )
    )  # fmt: skip
    order = draw(st.lists(st.floats(0, 5), min_size=len(cells), max_size=len(cells)))
    timed = sorted(zip(cells, order, strict=True), key=lambda pair: pair[0][0] + pair[1])
    return [(tick, {name: float(i + 1)}, i) for i, ((tick, name), _) in enumerate(timed)]


@given(arrivals())
def test_any_order_within_the_kept_rows_is_the_order_of_time(
    cells: list[tuple[int, dict[str, float], int]],
) -> None:
    """Channel by channel, late and early: the rows are the same as if all had come in time."""
    stream = Recorded(time_unit="ns", late="reorder", reorder_rows=12)
    start = 1_700_000_000_123_456_789
    for tick, values, _ in cells:
        assert stream.observe(start + tick, values) in ("new", "merged", "reordered")
    table: dict[int, dict[str, float]] = {}
    for tick, values, _ in cells:
        table.setdefault(tick, {}).update(values)
    rows = [(tick, tuple(table[tick].get(name) for name in NAMES)) for tick in sorted(table)]
    origin = cells[0][0]
    assert stream.rows == [((tick - origin) / 10**9, values) for tick, values in rows]
    assert stream.counters.rows == len(rows)
    assert stream.counters.merged == len(cells) - len(rows)


@given(
    st.lists(
        st.tuples(
            st.floats(-5, 5) | st.integers(-5, 5),
            st.dictionaries(st.sampled_from(NAMES), st.floats() | st.none()),
            st.none() | st.floats(-5, 5),
        ),
        max_size=30,
    ),
    st.fixed_dictionaries(
        {
            "late": st.sampled_from(["drop", "reorder"]),
            "duplicates": st.sampled_from(["first", "last"]),
            "jump": st.sampled_from(["reset", "continue", "drop"]),
            "jump_ahead_s": st.sampled_from([None, 1.5]),
            "merge_within_s": st.sampled_from([0.0, 0.1]),
            "stale_after_s": st.sampled_from([None, 0.5, 3.0]),
            "long_gap": st.sampled_from(["saturate", "reset"]),
            "reorder_rows": st.integers(1, 4),
            "confirm": st.integers(1, 3),
        }
    ),
)
def test_whatever_comes_every_message_is_accounted_for(
    messages: list[tuple[float, dict[str, float | None], float | None]], options: dict[str, Any]
) -> None:
    """The engine is fed in the order of time (it checks that), and nothing goes uncounted."""
    stream = Recorded(**options)
    outcomes = [stream.observe(t, values, now=now) for t, values, now in messages]
    counted = stream.counters
    assert counted.messages == len(messages)
    dropped = counted.late + counted.stale + counted.ahead
    # A merge that changes nothing is a duplicate, which is counted if a value came twice.
    silent = len(messages) - counted.rows - counted.merged - dropped - stream.pending
    assert 0 <= silent <= counted.duplicates + counted.empty
    assert outcomes.count("jumped") == counted.jumps_back + counted.jumps_ahead
    again = Recorded(**options)
    again.restore(stream.state())
    assert again.state() == stream.state()
    assert again.rows == stream.rows


# --- stale ones -----------------------------------------------------------------------------------


def test_what_waited_too_long_is_stale_even_if_nothing_newer_has_come() -> None:
    stream = Recorded(stale_after_s=0.2)
    assert stream.observe(1.0, {"a": 1.0}, now=1.1) == "new"
    assert stream.observe(1.5, {"a": 2.0}, now=1.8) == "stale"
    assert stream.observe(1.7, {"a": 2.0}, now=1.8) == "new"
    assert [time for time, _ in stream.rows] == [0.0, pytest.approx(0.7)]
    assert stream.counters.stale == 1


def test_what_is_late_by_too_much_is_stale_although_it_could_be_placed() -> None:
    stream = Recorded(stale_after_s=0.2, late="reorder")
    assert said(stream, (1.0, {"a": 1.0}), (1.5, {"a": 2.0}), (1.2, {"b": 1.0}), (1.4, {"b": 1.0}),
                ) == ["new", "new", "stale", "reordered"]  # fmt: skip
    assert stream.counters.stale == 1


# --- clocks that jump -----------------------------------------------------------------------------


def test_a_clock_that_was_set_back_is_believed_after_some_messages_and_none_is_lost() -> None:
    stream = Recorded(confirm=3)
    said(stream, (100.0, {"a": 1.0}), (100.1, {"a": 2.0}))
    outcomes = said(stream, (0.0, {"a": 3.0}), (0.1, {"a": 4.0}), (0.1, {"b": 5.0}))
    assert outcomes == ["pending", "pending", "jumped"]
    assert stream.rows == [(0.0, (3.0, None, None)), (0.1, (4.0, 5.0, None))]
    assert stream.observe(0.2, {"a": 6.0}) == "new"
    assert stream.counted == {
        "messages": 6, "rows": 5, "merged": 1, "jumps_back": 1, "resets": 1,
        "longest_gap_s": pytest.approx(0.1),
    }  # fmt: skip


def test_one_wrong_stamp_in_the_past_changes_nothing() -> None:
    stream = Recorded(confirm=2)
    said(stream, (100.0, {"a": 1.0}))
    assert said(stream, (0.0, {"b": 1.0}), (100.1, {"a": 2.0}), (0.0, {"b": 1.0}),
                (100.2, {"a": 3.0})) == ["pending", "new", "pending", "new"]  # fmt: skip
    assert [values[0] for _, values in stream.rows] == [1.0, 2.0, 3.0]
    assert (stream.counters.late, stream.pending, stream.counters.resets) == (2, 0, 0)


def test_wrong_stamps_that_do_not_agree_are_no_jump() -> None:
    stream = Recorded(confirm=2)
    said(stream, (100.0, {"a": 1.0}))
    assert said(stream, (50.0, {"a": 1.0}), (3.0, {"a": 2.0}), (3.1, {"a": 3.0})) == [
        "pending", "pending", "jumped",
    ]  # fmt: skip
    assert [values[0] for _, values in stream.rows] == [2.0, 3.0]
    assert stream.counters.late == 1


def test_what_was_pending_is_put_in_its_place_if_the_clock_did_not_jump() -> None:
    stream = Recorded(late="reorder")
    said(stream, (1.0, {"a": 1.0}), (4.0, {"a": 2.0}))
    assert said(stream, (2.5, {"b": 3.0}), (5.0, {"a": 4.0})) == ["pending", "new"]
    assert [time for time, _ in stream.rows] == [0.0, 1.5, 3.0, 4.0]
    assert stream.counters.reordered == 1


def test_a_wrong_stamp_in_the_future_does_not_end_the_stream() -> None:
    """By default it is a gap; the messages after it, on the old clock, are a clock set back."""
    stream = Recorded(confirm=3)
    said(stream, (1.0, {"a": 1.0}), (1e9, {"a": 2.0}))
    assert said(stream, *((1.1 + 0.1 * i, {"a": 3.0 + i}) for i in range(4))) == [
        "pending", "pending", "jumped", "new",
    ]  # fmt: skip
    assert [values[0] for _, values in stream.rows] == [3.0, 4.0, 5.0, 6.0]


def test_with_a_limit_a_wrong_stamp_in_the_future_is_pending_and_dropped() -> None:
    stream = Recorded(jump_ahead_s=60.0, confirm=2)
    said(stream, (1.0, {"a": 1.0}))
    assert said(stream, (1e9, {"a": 2.0}), (1.1, {"a": 3.0})) == ["pending", "new"]
    assert [values[0] for _, values in stream.rows] == [1.0, 3.0]
    assert stream.counters.ahead == 1
    assert said(stream, (1e9, {"a": 4.0}), (1e9 + 1, {"a": 5.0})) == ["pending", "jumped"]
    assert [values[0] for _, values in stream.rows] == [4.0, 5.0]
    assert (stream.counters.jumps_ahead, stream.counters.resets) == (1, 1)


def test_a_jump_may_be_replaced_by_the_median_gap() -> None:
    """For a clock that was corrected while the robot moved; the median gap is 0.1 s."""
    stream = Recorded(jump="continue", confirm=2, jump_ahead_s=60.0)
    said(stream, (100.0, {"a": 1.0}), (100.5, {"a": 2.0}), (0.0, {"a": 3.0}), (0.2, {"a": 4.0}),
         (0.3, {"a": 5.0}), (500.0, {"a": 6.0}), (500.1, {"a": 7.0}))  # fmt: skip
    times = [time for time, _ in stream.rows]
    assert times == pytest.approx([0.0, 0.5, 0.6, 0.8, 0.9, 1.0, 1.1])
    assert [values[0] for _, values in stream.rows] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert stream.predict(500.2)[0] == 7.0
    assert (stream.counters.jumps_back, stream.counters.jumps_ahead) == (1, 1)
    assert stream.counters.resets == 0


def test_a_jump_may_be_ruled_out_or_be_an_error() -> None:
    stream = Recorded(jump="drop", jump_ahead_s=60.0, confirm=1)
    said(stream, (100.0, {"a": 1.0}))
    assert said(stream, *((float(t), {"a": 2.0}) for t in range(9))) == ["late"] * 9
    assert stream.observe(1e6, {"a": 2.0}) == "ahead"
    assert len(stream.rows) == 1
    strict = Recorded(jump="error", jump_ahead_s=60.0)
    said(strict, (100.0, {"a": 1.0}))
    for t in (98.0, 200.0):
        with pytest.raises(InputError):
            strict.observe(t, {"a": 2.0})
    assert strict.observe(101.0, {"a": 2.0}) == "new"


# --- long gaps ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("limit", "longest"), [(None, 2.0), (0.5, 0.5)])
@pytest.mark.parametrize("option", ["saturate", "reset"])
def test_long_gaps_are_counted_and_may_reset(
    option: str, limit: float | None, longest: float
) -> None:
    stream = Recorded(long_gap=option, long_gap_s=limit)
    usual = 0.99 * longest
    said(stream, (0.0, {"a": 1.0}), (usual, {"a": 2.0}), (2 * usual, {}))
    assert stream.counters.long_gaps == 0
    said(stream, (usual + 1.01 * longest, {"a": 3.0}))
    assert stream.counters.long_gaps == 1
    assert stream.counters.longest_gap_s == pytest.approx(1.01 * longest)
    kept = [values[0] for _, values in stream.rows]
    assert kept == ([3.0] if option == "reset" else [1.0, 2.0, None, 3.0])
    assert stream.counters.resets == (option == "reset")


def test_after_a_gap_that_reset_the_state_older_messages_do_not_come_back() -> None:
    stream = Recorded(long_gap="reset", late="reorder", jump="drop")
    said(stream, (0.0, {"a": 1.0}), (5.0, {"a": 2.0}))
    assert said(stream, (-0.5, {"b": 1.0}), (0.0, {"b": 1.0}), (4.5, {"b": 1.0})) == [
        "late", "late", "reordered",
    ]  # fmt: skip
    assert stream.rows == [(4.5, (None, 1.0, None)), (5.0, (2.0, None, None))]


def test_every_outcome_and_every_counter_is_met_by_these_tests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One stream that meets all of them, so that none is dead."""

    def gives_up(*_: Any) -> None:
        raise DivergenceError("no step is small enough")

    stream = Recorded(late="reorder", reorder_rows=2, jump_ahead_s=60.0, confirm=2,
                      stale_after_s=5.0)  # fmt: skip
    nan, inf = float("nan"), float("inf")
    steps: list[tuple[float, Any, float | None]] = [
        (0.0, [1, nan, nan], None), (0.1, [1, nan, nan], None), (0.1, [nan, 2, inf], None),
        (0.1, [1, nan, nan], None), (0.2, [nan] * 3, None), (0.15, [1, nan, nan], None),
        (0.0, [nan, 1, nan], None), (0.3, [1, 1, 1], 9.0), (999.0, [1, 1, 1], None),
        (5.0, [1, 1, 1], None), (999.0, [1, 1, 1], None), (999.1, [1, 1, 1], None),
        (1.0, [1, 1, 1], None), (1.1, [1, 1, 1], None),
    ]  # fmt: skip
    outcomes = {stream.observe(t, values, now=now) for t, values, now in steps}
    with monkeypatch.context() as once:
        once.setattr(stream.recorder, "observe", gives_up)
        with pytest.raises(DivergenceError, match="no step is small enough"):
            stream.observe(1.2, [1, 1, 1])
    stream.observe(70.0, [1, 1, 1])
    stream.predict(70.0)
    assert outcomes == {"new", "merged", "duplicate", "reordered", "late", "stale", "pending",
                        "jumped"}  # fmt: skip
    assert [name for name, count in stream.counters.to_dict().items() if not count] == []


def test_counters_are_plain_numbers_that_json_knows() -> None:
    stream = Recorded()
    for t in (np.float64(1.0), np.float32(0.5), np.int64(7), np.array(8.0)[()]):
        stream.observe(t, np.array([1, 2, 3]))
    assert all(type(count) in (int, float) for count in stream.counters.to_dict().values())
