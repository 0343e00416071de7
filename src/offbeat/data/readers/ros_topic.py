"""Decoding of a topic of a ROS bag to signals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from offbeat.data.readers.options import Fields
from offbeat.data.readers.ros_layout import (
    Column,
    Definitions,
    Layout,
    UnreadableTypeError,
    find_layout,
)
from offbeat.data.signals import Signal
from offbeat.errors import FileFormatError

_Key = tuple[str, tuple[str, ...]]
_MOST_FRAMES = 16  # of one signal
_FEW_ROWS = 10
_LAYOUTS = 64  # kept per topic and length of message


@dataclass
class _Part:
    """Rows of one signal from one layout, out of one batch of messages."""

    order: NDArray[np.intp]
    header: NDArray[np.int64] | None
    received: NDArray[np.int64]
    values: NDArray[np.float64]
    columns: tuple[Column, ...]


@dataclass
class Topic:
    """A topic while it is read: waiting messages, and the decoded parts of earlier ones.

    Args:
        name: of the topic.
        kind: type of its messages.
        definitions: fields of that type and of its nested types.
        cdr: serialised by ROS 2; else by ROS 1.
        fields: the selected fields.
        times: times of receipt of the waiting messages, in nanoseconds.
        messages: the waiting messages.
        parts: decoded rows, by the suffix of their signal and their frames.
        layouts: known layouts, by the length of their messages.
        skipped: fields that are left out, each with the reason.
        optional: whether the topic is left out if its messages have a type that can't be read.
        unreadable: why it is left out.
    """

    name: str
    kind: str
    definitions: Definitions
    cdr: bool
    fields: Fields
    times: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    parts: dict[_Key, list[_Part]] = field(default_factory=dict)
    layouts: dict[int, list[Layout]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    optional: bool = False
    unreadable: str = ""

    def decode(self) -> None:
        """Decodes the waiting messages."""
        try:
            if not self.unreadable:
                self._decode()
        except UnreadableTypeError as error:
            if not self.optional:
                raise
            self.unreadable = str(error)
            self.parts.clear()
        self.times, self.messages = [], []

    def _decode(self) -> None:
        received = np.array(self.times, dtype=np.int64)
        lengths = np.fromiter(map(len, self.messages), dtype=np.intp, count=len(self.messages))
        found: dict[_Key, list[_Part]] = {}
        for length in np.unique(lengths):
            where = np.flatnonzero(lengths == length)
            joined = b"".join([self.messages[i] for i in where])
            table = np.frombuffer(joined, np.uint8).reshape(len(where), length)
            known = self.layouts.setdefault(int(length), [])
            for layout in list(known):
                fits = layout.fits(table)
                if fits.any():
                    self._take(layout, table[fits], where[fits], received, found)
                    table, where = table[~fits], where[~fits]
            while len(where):
                layout = self._layout(self.messages[where[0]])
                if len(known) < _LAYOUTS:
                    known.append(layout)
                fits = layout.fits(table)
                self._take(layout, table[fits], where[fits], received, found)
                table, where = table[~fits], where[~fits]
        for suffix, parts in found.items():
            self.parts.setdefault(suffix, []).extend(_in_order(parts))

    def _layout(self, message: bytes) -> Layout:
        try:
            layout = find_layout(
                message,
                self.kind,
                self.definitions,
                cdr=self.cdr,
                wanted=self.fields.of(self.name),
            )
        except FileFormatError as error:
            raise type(error)(f"topic {self.name}: {error}") from None
        for name, why in layout.skipped.items():
            self.skipped.setdefault(name, why)
        self.fields.available.update(dict.fromkeys(layout.available))
        return layout

    def _take(
        self,
        layout: Layout,
        table: NDArray[np.uint8],
        where: NDArray[np.intp],
        received: NDArray[np.int64],
        found: dict[_Key, list[_Part]],
    ) -> None:
        for row in layout.rows:
            found.setdefault((row.suffix, row.frames), []).append(
                _Part(
                    where,
                    layout.stamps(table, row),
                    received[where],
                    layout.values(table, row),
                    tuple(row.columns),
                )
            )

    @property
    def has_header(self) -> bool:
        """Whether every row has a header stamp, and not all of them are 0."""
        every = [part.header for parts in self.parts.values() for part in parts]
        return bool(every) and all(
            stamps is not None and bool((stamps != 0).any()) for stamps in every
        )

    @property
    def is_stuck(self) -> bool:
        """Whether most rows of a signal have the header stamp of the one before, unlike receipt."""
        for parts in self.parts.values():
            headers = [part.header for part in parts if part.header is not None]
            received = np.concatenate([part.received for part in parts])
            stamps = np.concatenate(headers) if headers else received
            steps, apart = np.count_nonzero(np.diff(stamps)), np.count_nonzero(np.diff(received))
            if len(stamps) > _FEW_ROWS and 2 * steps < apart:
                return True
        return False

    def offset(self) -> float:
        """The median of header stamp minus time of receipt, in nanoseconds."""
        every = [
            part.header - part.received
            for parts in self.parts.values()
            for part in parts
            if part.header is not None
        ]
        return float(np.median(np.concatenate(every)))

    def _names(self, notes: list[str]) -> dict[_Key, str]:
        """The name of the signal of each suffix and frame."""
        frames_of: dict[str, list[tuple[str, ...]]] = {}
        for suffix, frames in self.parts:
            frames_of.setdefault(suffix, []).append(frames)
        named: dict[_Key, str] = {}
        for suffix, several in frames_of.items():
            several.sort()
            start = [self.name, suffix] if suffix else [self.name]
            shown = ", ".join("/".join(frames) or "''" for frames in several[:4])
            if len(several) > _MOST_FRAMES:
                notes.append(
                    f"{'/'.join(start)}: the frame changes between {len(several)} ({shown}, ...); "
                    "they are read as one"
                )
            elif len(several) > 1:
                notes.append(
                    f"{'/'.join(start)} is given in several frames ({shown}); each is a signal"
                )
            for frames in several:
                inner = [self.name, *frames, suffix] if suffix else [self.name, *frames]
                apart = 1 < len(several) <= _MOST_FRAMES
                named[suffix, frames] = "/".join(inner if apart else start)
        return named

    def span(self, *, header: bool) -> tuple[int, int]:
        """The first and the last stamp."""
        every = [
            stamps
            for parts in self.parts.values()
            for part in parts
            if (stamps := part.header if header else part.received) is not None
        ]
        return min(int(s.min()) for s in every), max(int(s.max()) for s in every)

    def signals(self, *, header: bool, notes: list[str]) -> Iterator[Signal]:
        """Yields the signals, and releases the decoded parts to save memory."""
        if self.skipped:
            notes.append(
                f"{self.name}: left out "
                + ", ".join(f"{name} ({why})" for name, why in self.skipped.items())
            )
        if not self.parts and not self.messages and not self.unreadable:
            notes.append(f"{self.name} ({self.kind}) has no selected numbers")
        if self.unreadable:
            notes.append(f"{self.name} is left out: {self.unreadable}")
            return
        names = self._names(notes)
        for key, name in names.items():
            if key not in self.parts:
                continue
            parts = self.parts.pop(key)
            others = [k for k, n in names.items() if n == name and k in self.parts]
            for other in others:
                parts += self.parts.pop(other)
            columns = {c.name: c for part in parts for c in part.columns}
            rows = sum(len(part.order) for part in parts)
            stamps = np.empty(rows, dtype=np.int64)
            values = np.empty((rows, len(columns)), order="F")
            place = {name: i for i, name in enumerate(columns)}
            first = 0
            for part in parts:
                last = first + len(part.order)
                taken = part.header if header else part.received
                assert taken is not None  # of `has_header`
                stamps[first:last] = taken
                if len(part.columns) < len(columns):
                    values[first:last] = np.nan
                at = [place[c.name] for c in part.columns]
                values[first:last, at] = part.values
                part.values = np.empty((0, 0))
                first = last
            if others:  # rows of several frames are in the order of the log only by their receipt
                order = np.argsort(np.concatenate([p.received for p in parts]), kind="stable")
                stamps, values = stamps[order], np.asfortranarray(values[order])
            yield Signal(
                name,
                stamps,
                values,
                tuple(columns),
                tuple(c.unit for c in columns.values()),
                _kinds(list(columns.values())),
            )


def _in_order(parts: list[_Part]) -> list[_Part]:
    """Joins the rows of all layouts of a batch, in the order of the log."""
    if len(parts) == 1:
        return parts
    order = np.concatenate([part.order for part in parts])
    if (np.diff(order) >= 0).all():
        return parts
    columns = {c.name: c for part in parts for c in part.columns}
    place = {name: i for i, name in enumerate(columns)}
    values = np.full((len(order), len(columns)), np.nan)
    first = 0
    for part in parts:
        last = first + len(part.order)
        values[first:last, [place[c.name] for c in part.columns]] = part.values
        first = last
    headers = [part.header for part in parts if part.header is not None]
    header = np.concatenate(headers) if len(headers) == len(parts) else None
    received = np.concatenate([part.received for part in parts])
    by = np.argsort(order, kind="stable")
    return [
        _Part(
            order[by],
            None if header is None else header[by],
            received[by],
            values[by],
            tuple(columns.values()),
        )
    ]


def _kinds(columns: list[Column]) -> tuple[str, ...]:
    """Kinds of the channels; incomplete quaternions have none."""
    kinds = [c.kind for c in columns]
    for i, column in enumerate(columns):
        whole = [f"{column.name[:-1]}{axis}" for axis in "xyzw"]
        start = i - "xyzw".find(column.name[-1])
        if column.kind == "quaternion" and [c.name for c in columns[start : start + 4]] != whole:
            kinds[i] = ""
    return tuple(kinds)
