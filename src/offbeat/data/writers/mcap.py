"""MCAP, through the package `mcap`: rows as JSON, and messages of the log's own types.

The format: mcap.dev/spec. Where the log is a bag of ROS 1 or ROS 2, each of its topics gets a
message at every row, of the same type, under the same name: the message before it in the log, with
the numbers and the stamp of the row. So viewers show both files side by side, and programs for one
read the other.

What was measured and the ends of the intervals are on the topic `/offbeat` then, whose type
`offbeat_msgs/msg/Row` is defined in the file. Of other logs, all rows are JSON on the topic
`/offbeat` (`/offbeat/LABEL` of several trajectories); `timestamp` has the form that Foxglove knows.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.readers.mcap_rows import KIND
from offbeat.data.trajectory import Dataset, Trajectory
from offbeat.data.writers.described import clocks, interval, labels
from offbeat.data.writers.ros_messages import Messages, messages_like, rows_as_messages
from offbeat.errors import InputError, require
from offbeat.files import atomic_path

TOPIC = "/offbeat"


def write_mcap(
    dataset: Dataset, path: str | Path, *, log: str | Path | None = None, level: float = 0.9
) -> None:
    """Writes a data set as MCAP.

    Args:
        dataset: any; its clock is that of the messages.
        path: the file.
        log: what the data set was read from; of a bag, its topics are repeated.
        level: probability of the intervals.

    Raises:
        InputError: a time is before 0 on the clock of the log.
        FileFormatError: the log is damaged.
        MissingExtraError: `mcap` is not installed, or `rosbags` for a bag.
        OSError: the file cannot be written.
    """
    mcap: Any = require("mcap.writer", "ros")
    stamps = clocks(dataset)
    if min(int(each[0]) for each in stamps) < 0:
        raise InputError("MCAP has no times before 0, and the clock of the log shows one there")
    topics = messages_like(log, dataset, stamps) if log is not None else []
    if topics:
        cdr = topics[0].encoding == "cdr"
        topics.append(rows_as_messages(dataset, stamps, TOPIC, cdr=cdr, level=level))
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = mcap.Writer(file, compression=mcap.CompressionType.NONE)
        writer.start(profile=topics[0].profile if topics else "", library="offbeat")
        rows: list[tuple[int, int, bytes]] = []  # in the order of time, as viewers read them
        for topic in topics:
            rows += _of_topic(writer, topic)
        if not topics:
            described = json.dumps(_schema(dataset)).encode()
            schema = writer.register_schema(KIND, "jsonschema", described)
            for label, trajectory, clock in zip(labels(dataset), dataset, stamps, strict=True):
                name = TOPIC if len(dataset) == 1 else f"{TOPIC}/{label}"
                channel, at = writer.register_channel(name, "json", schema), clock.tolist()
                texts = _rows(trajectory, at, level)
                rows += [(time, channel, text) for time, text in zip(at, texts, strict=True)]
        rows.sort(key=lambda row: row[0])
        for at, channel, data in rows:
            writer.add_message(channel, log_time=at, publish_time=at, data=data)
        writer.finish()


def _of_topic(writer: Any, topic: Messages) -> list[tuple[int, int, bytes]]:
    schema = writer.register_schema(topic.kind, topic.form, topic.definition.encode())
    metadata = {"offered_qos_profiles": ""} if topic.encoding == "cdr" else {}
    channel = writer.register_channel(topic.topic, topic.encoding, schema, metadata)
    return [(at, channel, data) for at, data in topic.messages]


def _schema(dataset: Dataset) -> dict[str, Any]:
    """The JSON schema of a row; units and roles are keys of Offbeat's own."""

    def each(kind: Any) -> dict[str, Any]:
        return {"type": "object", "properties": {n: {"type": kind} for n in dataset.names}}

    number = ["number", "null"]
    whole = {"type": "integer", "minimum": 0}
    time = {
        "type": "object",
        "title": "time",
        "properties": {"sec": whole, "nsec": {**whole, "maximum": 999_999_999}},
    }
    return {
        "title": KIND,
        "type": "object",
        "properties": {
            "timestamp": time,
            "values": each(number),
            "observed": each("boolean"),
            "low": each(number),
            "high": each(number),
        },
        "required": ["timestamp", "values", "observed"],
        "x-names": list(dataset.names),
        "x-units": list(dataset.units),
        "x-roles": list(dataset.roles),
    }


def _rows(trajectory: Trajectory, clock: list[int], level: float) -> list[bytes]:
    """Each row as JSON; what is not known is null."""
    tables = {"values": trajectory.values, "observed": trajectory.observed}
    ends = interval(trajectory, level)
    if ends is not None:
        tables |= {"low": ends[0], "high": ends[1]}
    lists = {
        name: np.where(np.isnan(table), None, table.astype(object)).tolist()  # type: ignore[call-overload]
        if table.dtype.kind == "f"
        else table.tolist()
        for name, table in tables.items()
    }
    texts = []
    for row, at in enumerate(clock):
        second, nanosecond = divmod(at, 10**9)
        said: dict[str, Any] = {"timestamp": {"sec": second, "nsec": nanosecond}}
        for name, table in lists.items():
            said[name] = dict(zip(trajectory.names, table[row], strict=True))
        texts.append(json.dumps(said, allow_nan=False).encode())
    return texts
