"""Options of a stream for messages out of order, and counters."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from offbeat.errors import InputError, one_of

Outcome = Literal[
    "new", "merged", "duplicate", "reordered", "late", "stale", "ahead", "pending", "jumped"
]
"""What was done with a message.

`new`: a row of its own. `merged`: joined the row of the same time. `duplicate`: had nothing new.
`reordered`: came late and was put in its place. `late`, `stale`, `ahead`: dropped. `pending`: waits
until it is clear whether the clock has jumped. `jumped`: the clock has.
"""


@dataclass(frozen=True)
class StreamOptions:
    """Options for messages out of order, repeated, stale or on another clock.

    With the defaults a stream of increasing times is the batch pass over the same rows, for any
    gaps, and a single wrong time stamp cannot end it.

    Attributes:
        merge_within_s: s; messages whose times differ by no more than this are one row, at the time
            of the first of them. At 0, equal times alone. The model goes back to before that row
            and sees it whole: the same as if all had come at once.
        duplicates: a value for a channel that the row of this time already has: keep the `last`
            one, as `read` does, the `first` one, or `error`.
        late: a message older than the newest row, by no more than `jump_back_s`: `drop` it;
            `reorder`, put it in its place and run the rows after it again; or `error`.
        reorder_rows: rows that are kept for `reorder`; what is older than these is dropped.
        stale_after_s: s; what is older than this on arrival is dropped, for any `late`:
            behind the `now` that `observe` is given, or else behind the newest row. None: never.
        jump: when the clock has jumped, `reset`, reset the state at the new time; `continue`, keep
            the state and treat the jump as one median gap; `drop`, keep the old clock, so that
            messages far behind it are late; or `error`.
        jump_back_s: s; a message older than the newest row by more than this may mean a clock that
            was set back (a simulation started again, a log played again).
        jump_ahead_s: s; a message newer than the newest row by more than this may mean a clock that
            was set ahead, or a wrong time stamp. None: it is a gap of any length.
        confirm: a clock has jumped when this number of messages in a row agrees; until then they
            are pending, and one message on the old clock makes them late ones. Nothing pending is
            lost: after the jump they are consumed.
        long_gap: after more than `long_gap_s` without a value, `saturate`, let the model's own
            limit act, or `reset`, reset the state.
        long_gap_s: s; None is the model's own limit, where time saturates.
        window_rows: newest rows that a model without a recurrent state is run on; None: as many as
            the longest trajectory that it was trained on.

    Raises:
        InputError: a value is none of these.
    """

    merge_within_s: float = 0.0
    duplicates: Literal["first", "last", "error"] = "last"
    late: Literal["drop", "reorder", "error"] = "drop"
    reorder_rows: int = 32
    stale_after_s: float | None = None
    jump: Literal["reset", "continue", "drop", "error"] = "reset"
    jump_back_s: float = 1.0
    jump_ahead_s: float | None = None
    confirm: int = 5
    long_gap: Literal["saturate", "reset"] = "saturate"
    long_gap_s: float | None = None
    window_rows: int | None = None

    def __post_init__(self) -> None:
        one_of("duplicates", self.duplicates, ("first", "last", "error"))
        one_of("late", self.late, ("drop", "reorder", "error"))
        one_of("jump", self.jump, ("reset", "continue", "drop", "error"))
        one_of("long_gap", self.long_gap, ("saturate", "reset"))
        for name in ("reorder_rows", "confirm", "window_rows"):
            value = getattr(self, name)
            if value is None and name == "window_rows":
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise InputError(f"{name} must be an integer of at least 1, got {value!r}")
        if not _is_number(self.merge_within_s) or not 0 <= self.merge_within_s < math.inf:
            raise InputError(
                f"merge_within_s must be 0 s or more, and finite, got {self.merge_within_s!r}"
            )
        for name in ("stale_after_s", "jump_back_s", "jump_ahead_s", "long_gap_s"):
            value = getattr(self, name)
            if value is None and name != "jump_back_s":
                continue
            if not _is_number(value) or not 0 < value < math.inf:
                raise InputError(f"{name} must be a positive number of seconds, got {value!r}")
            if name.startswith("jump") and value <= self.merge_within_s:
                raise InputError(
                    f"{name} is {value!r}, no longer than merge_within_s, {self.merge_within_s!r}: "
                    "the same message would be merged and a jump; make it longer"
                )

    @property
    def kept_rows(self) -> int:
        """Newest rows that are kept, each with the state before it."""
        return self.reorder_rows if self.late == "reorder" else 1


@dataclass
class StreamCounters:
    """Counters of a stream. A reset does not change them.

    Attributes:
        messages: given to `observe`, errors left out.
        rows: consumed by the model, reordered ones included.
        merged: messages that joined the row of the same time.
        duplicates: messages with a value that the row of the same time already had.
        reordered: late messages that were put in their place.
        late: late messages that were dropped.
        stale: messages that were dropped because they were too old.
        ahead: messages that were dropped for being far ahead.
        empty: messages in which nothing was measured.
        not_finite: values that were infinite, or too large for the model's numbers; they count as
            not measured.
        jumps_back: times the clock was set back.
        jumps_ahead: times the clock was set ahead.
        long_gaps: gaps longer than the limit.
        longest_gap_s: s, the longest time without a value.
        resets: times the state was reset, for any reason.
        predictions: times predicted at.
        recoveries: times the state was no longer finite, or a solver could not go on from it, and
            was reset.
    """

    messages: int = 0
    rows: int = 0
    merged: int = 0
    duplicates: int = 0
    reordered: int = 0
    late: int = 0
    stale: int = 0
    ahead: int = 0
    empty: int = 0
    not_finite: int = 0
    jumps_back: int = 0
    jumps_ahead: int = 0
    long_gaps: int = 0
    longest_gap_s: float = 0.0
    resets: int = 0
    predictions: int = 0
    recoveries: int = 0

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> StreamCounters:
        """The inverse of `to_dict`.

        Raises:
            InputError: a counter is missing, unknown or not a number.
        """
        names = {f.name for f in fields(cls)}
        if not isinstance(value, dict) or value.keys() != names:
            raise InputError(f"expected the counters {', '.join(sorted(names))}, got {value!r}")
        if not all(_is_number(number) and number >= 0 for number in value.values()):
            raise InputError(f"a counter is a number of at least 0, got {value!r}")
        return cls(**value)


def with_options(options: StreamOptions | None, changes: dict[str, Any]) -> StreamOptions:
    """Options with some fields replaced.

    Args:
        options: None for the defaults.
        changes: fields of `StreamOptions`.

    Raises:
        InputError: an unknown field, or a value out of its range.
    """
    for key in changes:
        one_of("stream option", key, [f.name for f in fields(StreamOptions)])
    return replace(options or StreamOptions(), **changes)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
