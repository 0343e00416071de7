"""ROS 1 bags, ROS 2 bags in SQLite (.db3) and MCAP, through `rosbags`.

`rosbags` opens the containers and parses the definitions of the messages; `ros_layout` decodes the
topics and fields that are asked for, thousands of messages at once. Memory holds what is returned
and a few megabytes of messages that wait to be decoded, however large the bag is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from offbeat.data.readers.ros_files import Bag, Connection, explained, open_bag
from offbeat.data.readers.ros_layout import Column, Definitions, Layout, find_layout
from offbeat.data.signals import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, one_of, require

SUFFIXES = (".bag", ".db3", ".mcap")

_MAGIC = (b"#ROSBAG V", b"SQLite format 3\0", b"\x89MCAP0\r\n")
_WAITING_BYTES = 16 * 2**20  # messages that wait to be decoded
_LAYOUTS = 64  # remembered per topic and length of message

# Without being asked for, nobody wants a camera's picture, a map or a log text as channels.
_NOT_BY_DEFAULT = (
    "bond/",
    "diagnostic_msgs/",
    "map_msgs/",
    "nav_msgs/msg/GridCells",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Path",
    "rcl_interfaces/",
    "rosgraph_msgs/",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/MultiEchoLaserScan",
    "sensor_msgs/msg/PointCloud",
    "stereo_msgs/",
    "visualization_msgs/",
)


def recognises(path: Path) -> bool:
    """Whether a file starts like a ROS bag or an MCAP file, or a folder holds a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    try:
        with path.open("rb") as file:
            return file.read(16).startswith(_MAGIC)
    except OSError:
        return False


def recordings(
    path: str | Path,
    *,
    topics: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
    stamps: str = "header",
    typestore: str = "latest",
) -> Iterator[Recording]:
    """Reads a ROS bag: one recording, a signal per topic.

    Args:
        path: a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag.
        topics: the topics to read; by default all whose messages hold numbers, but for pictures,
            scans, maps, markers, logs and transforms that never change.
        fields: fields to take, such as `pose.position` (with all below it), `velocity[0]`, or
            `/odom:twist.twist` for one topic alone; by default all numbers but covariances, long
            sequences, and what the header holds.
        stamps: `header` takes the stamps of the messages' headers, and the time of receipt where
            there is none; `receive` takes the time of receipt everywhere.
        typestore: the ROS distribution whose definitions are taken where a bag holds none, such
            as `ros2_humble`.

    Yields:
        The recording. Sequences of numbers become a channel per element, named by the message's
        own names where it has as many (`position.elbow` of joint states). A list of transforms
        becomes a signal per child frame.

    Raises:
        FileFormatError: the bag is truncated or damaged, a message type is not known, or nothing
            that was asked for holds a number.
        InputError: a topic, field or option is unknown.
        MissingExtraError: `rosbags` is not installed.
    """
    one_of("stamps", stamps, ("header", "receive"))
    require("rosbags", "ros")
    path = Path(path)
    if not path.is_dir():
        require_file(path)
    with open_bag(path) as bag:
        notes: list[str] = []
        chosen = _chosen(bag.connections, topics, path, notes)
        wanted = _Fields(fields, sorted({c.topic for c in chosen}))
        readers = _topic_readers(bag, chosen, wanted, typestore, path, notes, asked=bool(topics))
        _read(bag, chosen, readers, path)
    wanted.check()
    clocks = _clocks(list(readers.values()), stamps, notes)
    signals: list[Signal] = []
    for topic in readers.values():
        signals.extend(topic.signals(header=clocks[topic.name], notes=notes))
    if not signals:
        raise FileFormatError(
            f"{path} holds no numbers in {', '.join(readers) or 'any of its topics'}; it has the "
            f"topics {_listed(bag.connections)}; choose with topics="
        )
    yield Recording(tuple(signals), origin=path.name, time_unit="ns", notes=tuple(notes))


def _listed(connections: Sequence[Connection]) -> str:
    topics = {c.topic: f"{c.topic} ({c.kind})" for c in connections}
    return ", ".join(topics[name] for name in sorted(topics)) or "none"


def _chosen(
    connections: Sequence[Connection], topics: Sequence[str] | None, path: Path, notes: list[str]
) -> list[Connection]:
    """The connections of the topics to read."""
    if not connections:
        raise FileFormatError(f"{path} holds no topics; record it again")
    if topics is not None:
        known = {c.topic for c in connections}
        named = {one_of(f"topic of {path.name}", topic, known) for topic in topics}
        return [c for c in connections if c.topic in named]
    chosen, left = [], {}
    for connection in connections:
        if connection.kind.startswith(_NOT_BY_DEFAULT) or connection.topic.endswith("/tf_static"):
            left[connection.topic] = connection.kind
        elif connection.encoding not in ("ros1", "cdr"):
            left[connection.topic] = connection.encoding
        else:
            chosen.append(connection)
    if left:
        notes.append(
            "left out unless chosen with topics=: "
            + ", ".join(f"{name} ({kind})" for name, kind in sorted(left.items()))
        )
    return chosen


class _Fields:
    """Which fields are asked for; remembers which of them it met."""

    def __init__(self, fields: Sequence[str] | None, topics: list[str]) -> None:
        self.patterns: list[tuple[str, str]] | None = None
        self.met: set[tuple[str, str]] = set()
        self.available: dict[str, None] = {}
        if fields is None:
            return
        self.patterns = []
        for text in fields:
            topic, colon, name = text.rpartition(":")
            if colon:
                one_of(f"topic of field {text!r}", topic, topics)
            self.patterns.append((topic, name))

    def of(self, topic: str) -> Callable[[str], bool] | None:
        """Whether a channel of this topic is wanted; None where the defaults hold."""
        patterns = self.patterns
        if patterns is None:
            return None
        mine = [pattern for pattern in patterns if pattern[0] in ("", topic)]

        def wanted(name: str) -> bool:
            for pattern in mine:
                field = pattern[1]
                if name.startswith(field) and name[len(field) : len(field) + 1] in ("", ".", "["):
                    self.met.add(pattern)
                    return True
            return False

        return wanted

    def check(self) -> None:
        """Raises `InputError` for a field that no message had."""
        if self.patterns is None:
            return
        for pattern in self.patterns:
            if pattern not in self.met:
                one_of("field", pattern[1], self.available)


@dataclass
class _Part:
    """Rows of one signal from one layout, out of one heap of messages."""

    order: NDArray[np.intp]
    header: NDArray[np.int64] | None
    received: NDArray[np.int64]
    values: NDArray[np.float64]
    columns: tuple[Column, ...]


@dataclass
class _Topic:
    """A topic while it is read: messages that wait, and what was decoded of those before."""

    name: str
    kind: str
    definitions: Definitions
    cdr: bool
    fields: _Fields
    times: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    parts: dict[str, list[_Part]] = field(default_factory=dict)
    layouts: dict[int, list[Layout]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def decode(self) -> None:
        """Decodes the messages that wait."""
        received = np.array(self.times, dtype=np.int64)
        lengths = np.fromiter(map(len, self.messages), dtype=np.intp, count=len(self.messages))
        found: dict[str, list[_Part]] = {}
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
        self.times, self.messages = [], []

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
            raise FileFormatError(f"topic {self.name}: {error}") from None
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
        found: dict[str, list[_Part]],
    ) -> None:
        for row in layout.rows:
            found.setdefault(row.suffix, []).append(
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
        """The signals; what was decoded is given up on the way, to save memory."""
        if self.skipped:
            notes.append(
                f"{self.name}: left out "
                + ", ".join(f"{name} ({why})" for name, why in self.skipped.items())
            )
        if not self.parts and not self.messages:
            notes.append(f"{self.name} ({self.kind}) holds no numbers that are asked for")
        for suffix in list(self.parts):
            parts = self.parts.pop(suffix)
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
                order = [place[c.name] for c in part.columns]
                values[first:last, order] = part.values
                part.values = np.empty((0, 0))
                first = last
            yield Signal(
                f"{self.name}/{suffix}" if suffix else self.name,
                stamps,
                values,
                tuple(columns),
                tuple(c.unit for c in columns.values()),
                _kinds(list(columns.values())),
            )


def _in_order(parts: list[_Part]) -> list[_Part]:
    """The rows of a heap of messages as they were logged, whatever layouts took turns."""
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
    """Kinds of the channels; a quaternion of which a part was not asked for is none."""
    kinds = [c.kind for c in columns]
    for i, column in enumerate(columns):
        whole = [f"{column.name[:-1]}{axis}" for axis in "xyzw"]
        start = i - "xyzw".find(column.name[-1])
        if column.kind == "quaternion" and [c.name for c in columns[start : start + 4]] != whole:
            kinds[i] = ""
    return tuple(kinds)


def _topic_readers(
    bag: Bag,
    chosen: list[Connection],
    fields: _Fields,
    typestore: str,
    path: Path,
    notes: list[str],
    *,
    asked: bool,
) -> dict[str, _Topic]:
    """A reader per topic that is to be read and whose messages are defined."""
    from rosbags.typesys import Stores, get_typestore

    stores = {store.value: store for store in Stores if store.value.startswith(("ros2", "latest"))}
    one_of("typestore", typestore, stores)
    base = dict(get_typestore(Stores.EMPTY).fielddefs)
    readers: dict[str, _Topic] = {}
    assumed: list[str] = []
    for connection in chosen:
        name, kind = connection.topic, connection.kind
        if connection.encoding not in ("ros1", "cdr"):
            raise FileFormatError(
                f"{path}: topic {name} is serialised as {connection.encoding!r}, only the "
                "messages of ROS can be read; leave it out with topics="
            )
        if name in readers:
            if readers[name].kind != kind:
                raise FileFormatError(
                    f"{path}: topic {name} has messages of two types, {readers[name].kind} and "
                    f"{kind}; split the bag"
                )
            continue
        with explained(path):
            definitions = base | connection.parsed()
        if kind not in definitions:
            definitions = dict(get_typestore(stores[typestore]).fielddefs)
            if kind in definitions:
                assumed.append(name)
            elif not asked:
                notes.append(
                    f"{name} is left out: its type {kind} is defined neither in the bag nor in "
                    f"the typestore {typestore}"
                )
                continue
            else:
                raise FileFormatError(
                    f"{path}: the message type {kind} of topic {name} is defined neither in the "
                    f"bag nor in the typestore {typestore!r}; name the distribution that has it "
                    f"with typestore=, one of: {', '.join(sorted(stores))}"
                )
        readers[name] = _Topic(name, kind, definitions, bag.cdr, fields)
    if assumed:
        notes.append(
            f"the bag does not define the messages of {', '.join(assumed)}; the definitions of "
            f"the typestore {typestore} are taken (typestore= names another)"
        )
    return readers


def _read(bag: Bag, chosen: list[Connection], readers: dict[str, _Topic], path: Path) -> None:
    """Hands every message of the chosen topics to its reader, a heap at a time."""
    heaps = {c.id: readers[c.topic] for c in chosen if c.topic in readers}
    waiting = 0
    try:
        for number, received, message in bag.messages(set(heaps)):
            heap = heaps[number]
            heap.times.append(received)
            heap.messages.append(message)
            waiting += len(message) + 100
            if waiting > _WAITING_BYTES:
                waiting = 0
                for topic in readers.values():
                    topic.decode()
        for topic in readers.values():
            topic.decode()
    except FileFormatError as error:
        if str(path) in str(error):
            raise
        raise FileFormatError(f"{path}: {error}") from None


def _clocks(topics: list[_Topic], stamps: str, notes: list[str]) -> dict[str, bool]:
    """Whether each topic takes the stamps of its headers.

    Topics without a header have the time of receipt alone. Where that clock and the one of the
    headers have no time in common (a simulator's clock, a bag played again), all take the time of
    receipt: merged signals need one clock.
    """
    chosen = {t.name: stamps == "header" and t.has_header for t in topics}
    if stamps == "receive":
        return chosen
    filled = [t for t in topics if t.parts]
    headed = [t for t in filled if chosen[t.name]]
    without = [t for t in filled if not chosen[t.name]]
    if headed and without:
        spans = [t.span(header=True) for t in headed]
        start, stop = min(s[0] for s in spans), max(s[1] for s in spans)
        apart = [
            t.name
            for t in without
            for first, last in [t.span(header=False)]
            if last < start or first > stop
        ]
        if apart:
            notes.append(
                f"stamps are times of receipt: {', '.join(apart)} has no others, and the clock of "
                "the headers elsewhere has no time in common with them"
            )
            return dict.fromkeys(chosen, False)
    if without:
        notes.append(
            "stamps are times of receipt, for want of a header stamp, in "
            + ", ".join(t.name for t in without)
        )
    return chosen
