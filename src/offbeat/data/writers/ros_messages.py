"""Messages like those of a ROS bag, at other times and with other numbers.

A message is copied as bytes, and only the numbers that are channels and the stamp of its header are
replaced at their places: texts, covariances and whatever else it holds stay those of the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.readers import ros
from offbeat.data.readers.ros_files import Bag, Connection, explained, open_bag
from offbeat.data.readers.ros_layout import Layout, Row, find_layout
from offbeat.data.trajectory import Dataset
from offbeat.data.writers.described import interval
from offbeat.errors import FileFormatError, require

_FORMS = {("cdr", "msg"): "ros2msg", ("cdr", "idl"): "ros2idl", ("ros1", "msg"): "ros1msg"}

ROW = "offbeat_msgs/msg/Row"
"""Type of the messages that hold what was measured and intervals."""

_ROW = """
builtin_interfaces/Time stamp
string[] names
float64[] values
bool[] observed
float64[] low
float64[] high
"""


@dataclass(frozen=True)
class Messages:
    """The messages of one topic.

    Attributes:
        topic: its name.
        kind: type of its messages, as the schema calls it.
        encoding: `cdr` or `ros1`.
        form: encoding of the definition, such as `ros2msg`.
        definition: of the type.
        messages: nanoseconds and serialised message, in the order of the rows.
    """

    topic: str
    kind: str
    encoding: str
    form: str
    definition: str
    messages: list[tuple[int, bytes]]

    @property
    def profile(self) -> str:
        """The profile of MCAP for such topics."""
        return "ros2" if self.encoding == "cdr" else "ros1"


def messages_like(
    log: str | Path, dataset: Dataset, stamps: Sequence[NDArray[np.int64]]
) -> list[Messages]:
    """Messages at the rows of a data set, for every topic of a bag that has a channel in it.

    Lists of transforms are left out, as one message holds several frames.

    Args:
        log: the bag; of another file there are no messages.
        dataset: read from it; its channels are called `FIELD`, or `TOPIC.FIELD` of several topics.
        stamps: (rows,) nanoseconds per trajectory, on the clock of the log.

    Raises:
        FileFormatError: the bag is damaged.
        MissingExtraError: `rosbags` is not installed.
    """
    log = Path(log)
    if not ros.recognises(log):
        return []
    require("rosbags", "ros")
    at = np.concatenate(list(stamps))
    values = np.concatenate([t.values for t in dataset])
    order = np.argsort(at, kind="stable")
    place = {name: i for i, name in enumerate(dataset.names)}
    made = []
    with open_bag(log) as bag:
        for connection in {c.topic: c for c in bag.connections}.values():
            form = _FORMS.get((connection.encoding, connection.form or "msg"))
            if form is None:
                continue
            start = f"{connection.topic}."
            if not any(name.startswith(start) for name in place):
                start = ""
            definitions, text = _definitions(connection)
            if connection.kind not in definitions:
                continue
            found = _Templates(bag, connection, definitions, log)
            if not found.use(place, start):
                continue
            rows = [(int(at[i]), found.message(int(at[i]), values[i])) for i in order]
            name = connection.kind
            if connection.encoding == "ros1":
                name = name.replace("/msg/", "/")
            made.append(Messages(connection.topic, name, connection.encoding, form, text, rows))
    return made


def rows_as_messages(
    dataset: Dataset, stamps: Sequence[NDArray[np.int64]], topic: str, *, cdr: bool, level: float
) -> Messages:
    """The rows of a data set as messages of the type `offbeat_msgs/msg/Row`.

    Its definition is part of the file, so that any program of ROS reads it.

    Args:
        dataset: any.
        stamps: (rows,) nanoseconds per trajectory.
        topic: its name.
        cdr: serialised as by ROS 2; else as by ROS 1.
        level: probability of the intervals, which are empty where there are none.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST if cdr else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_ROW, ROW))
    row, time = store.types[ROW], store.types["builtin_interfaces/msg/Time"]
    write = store.serialize_cdr if cdr else store.serialize_ros1
    rows = []
    for trajectory, clock in zip(dataset, stamps, strict=True):
        none = np.zeros((trajectory.rows, 0))
        low, high = interval(trajectory, level) or (none, none)
        for i, at in enumerate(clock.tolist()):
            message = row(
                time(*divmod(at, 10**9)),
                list(trajectory.names),
                trajectory.values[i],
                trajectory.observed[i],
                np.ascontiguousarray(low[i]),
                np.ascontiguousarray(high[i]),
            )
            rows.append((at, bytes(write(message, ROW))))
    text, _ = store.generate_msgdef(ROW, ros_version=2 if cdr else 1)
    name = ROW if cdr else ROW.replace("/msg/", "/")
    encoding = "cdr" if cdr else "ros1"
    return Messages(topic, name, encoding, _FORMS[encoding, "msg"], text, rows)


def _definitions(connection: Connection) -> tuple[dict[str, Any], str]:
    """Fields of the types of a topic, and their definition as text."""
    from rosbags.typesys import Stores, get_typestore

    base = dict(get_typestore(Stores.EMPTY).fielddefs)
    definitions = base | connection.parsed()
    if connection.kind in definitions:
        return definitions, connection.definition
    store = get_typestore(Stores.LATEST)
    if connection.kind not in store.fielddefs:
        return {}, ""
    text, _ = store.generate_msgdef(connection.kind, ros_version=2)
    return dict(store.fielddefs), text


class _Templates:
    """The messages of a topic, as templates for others."""

    def __init__(
        self, bag: Bag, connection: Connection, definitions: dict[str, Any], log: Path
    ) -> None:
        self.raw: list[bytes] = []
        self.layouts: list[Layout] = []
        stamps: list[int] = []
        known: dict[int, list[Layout]] = {}
        ids = {c.id for c in bag.connections if c.topic == connection.topic}
        cdr = connection.encoding == "cdr"
        with explained(log):
            for _, received, message in bag.messages(ids):
                table = np.frombuffer(message, np.uint8)[None]
                several = known.setdefault(len(message), [])
                layout = next((one for one in several if one.fits(table)[0]), None)
                if layout is None:
                    try:
                        layout = find_layout(
                            message,
                            connection.kind,
                            definitions,
                            cdr=cdr,
                            wanted=lambda _: True,
                        )
                    except FileFormatError:
                        continue
                    several.append(layout)
                if len(layout.rows) != 1 or layout.rows[0].suffix:
                    continue
                header = layout.stamps(table, layout.rows[0])
                stamp = int(header[0]) if header is not None and header[0] else received
                self.raw.append(message)
                self.layouts.append(layout)
                stamps.append(stamp)
        order = np.argsort(stamps, kind="stable")
        self.stamps = np.array(stamps, dtype=np.int64)[order]
        self.raw = [self.raw[i] for i in order]
        self.layouts = [self.layouts[i] for i in order]

    def use(self, place: dict[str, int], start: str) -> bool:
        """Finds the channels among the fields; returns whether there is one."""
        self.columns: dict[int, list[tuple[int, str, int]]] = {}
        for layout in {id(one): one for one in self.layouts}.values():
            self.columns[id(layout)] = [
                (column.offset, column.code, place[start + column.name])
                for column in _row(layout).columns
                if start + column.name in place
            ]
        return any(self.columns.values())

    def message(self, stamp: int, values: NDArray[np.float64]) -> bytes:
        """The last message up to a time, or the first, with other numbers and another stamp."""
        i = max(int(np.searchsorted(self.stamps, stamp, side="right")) - 1, 0)
        layout, data = self.layouts[i], bytearray(self.raw[i])
        for offset, code, channel in self.columns[id(layout)]:
            value = values[channel]
            kind = np.dtype(code)
            if kind.kind in "iu":
                if np.isnan(value):
                    continue
                limits = np.iinfo(kind)
                value = min(max(round(float(value)), limits.min), limits.max)
            data[offset : offset + kind.itemsize] = np.array(value, dtype=kind).tobytes()
        header = _row(layout).stamp
        if header is not None:
            second, nanosecond = divmod(stamp, 10**9)
            data[header[0] : header[0] + 4] = np.array(second, layout.order + "i4").tobytes()
            data[header[1] : header[1] + 4] = np.array(nanosecond, layout.order + "u4").tobytes()
        return bytes(data)


def _row(layout: Layout) -> Row:
    return layout.rows[0]
