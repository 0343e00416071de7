"""Messages of ROS as text: what `rostopic echo` and `ros2 topic echo` print."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from offbeat.data.memory import require_memory
from offbeat.data.readers.json_lines import recordings_of_rows
from offbeat.data.readers.table_options import TableOptions
from offbeat.data.readers.text import TextFile, start_of
from offbeat.data.recording import Recording
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError

SUFFIXES = (".yaml", ".yml", ".echo", ".txt", ".log")
"""Of the files that a user redirects the printed messages to."""

_BETWEEN = "---"
_FIELD = re.compile(rb"[A-Za-z_]\w*:")
_LONGEST, _DEEPEST = 200_000, 20  # characters of a message, and its nesting
_TRUE, _FALSE, _NONE = ("true", "True"), ("false", "False"), ("", "~", "null")


def read_ros_echo(
    path: str | Path,
    *,
    time_column: str | Sequence[str] | None = None,
    channels: Sequence[str] | None = None,
    without: Sequence[str] = (),
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    rate_hz: float | None = None,
) -> list[Recording]:
    """Reads the messages of a topic that were printed as YAML, with `---` between them.

    Fields become columns as in JSON: `pose.position.x`, `position[0]`. Two fields of a stamp, such
    as `header.stamp.sec` and `header.stamp.nanosec`, are joined. A last message that is cut off
    is left out, which is noted.

    Args:
        path: the file; it may be compressed, as text.
        time_column: as of `read_csv`.
        channels: as of `read_csv`.
        without: as of `read_csv`.
        time_unit: as of `read_csv`.
        units: as of `read_csv`.
        rate_hz: as of `read_csv`, for messages without a stamp.

    Returns:
        One recording, a row per message.

    Raises:
        FileFormatError: a message is no YAML, has aliases, is longer than 200,000 characters or
            nested too deeply; there is no time, or no channel of numbers.
        InputError: an option names an unknown column or unit.
    """
    path = require_file(path)
    require_memory(path, 8 * path.stat().st_size, f"{path.stat().st_size} bytes of messages")
    options = TableOptions(
        time_column=time_column, channels=channels, without=without, units=units, rate_hz=rate_hz
    )
    notes: list[str] = []
    return recordings_of_rows(_messages(path, notes), path, "YAML", options, time_unit, notes)


def recognises(path: Path) -> bool:
    """Whether a file holds fields of YAML with a line of `---` after them."""
    lines = [line.rstrip() for line in start_of(path).splitlines()]
    if lines and lines[0] == _BETWEEN.encode():
        lines = lines[1:]
    return bool(lines and _FIELD.match(lines[0]) and _BETWEEN.encode() in lines)


def _messages(path: Path, notes: list[str]) -> Iterator[dict[str, Any]]:
    """The messages of a file."""
    import yaml

    lines: list[str] = []
    length = number = 0
    for line in TextFile.of(path).lines():
        if line.rstrip() == _BETWEEN:
            number += 1
            if any(one.strip() for one in lines):
                try:
                    yield _message(lines, path, number)
                except yaml.YAMLError as error:
                    reason = " ".join(str(getattr(error, "problem", error)).split())[:80]
                    raise FileFormatError(
                        f"{path} is no YAML in message {number} ({reason})"
                    ) from None
            lines, length = [], 0
            continue
        lines.append(line)
        length += len(line)
        if length > _LONGEST:
            raise FileFormatError(
                f"{path} has a message of more than {_LONGEST} characters; print it with --noarr "
                "(--no-arr), or record a bag"
            )
    if any(one.strip() for one in lines):  # the printing was stopped, perhaps within it
        notes.append("the last message has no --- after it, and is left out")


def _message(lines: Sequence[str], path: Path, number: int) -> dict[str, Any]:
    """The fields of a message. Events are put together here: no recursion, no tags, no aliases."""
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    whole: list[Any] = []
    inside: list[tuple[Any, list[str]]] = []  # containers, and the name that waits for a value

    def put(value: Any) -> None:
        if not inside:
            whole.append(value)
            return
        container, keys = inside[-1]
        if isinstance(container, list):
            container.append(value)
        elif keys:
            container[keys.pop()] = value
        else:
            keys.append(str(value))

    for event in yaml.parse("".join(lines), loader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise FileFormatError(f"{path} has aliases in message {number}; ROS prints none")
        if isinstance(event, yaml.ScalarEvent):
            is_name = bool(inside) and _awaits(inside[-1])
            put(event.value if event.style or is_name else _value(event.value))
        elif isinstance(event, yaml.CollectionStartEvent):
            container: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
            put(container)
            inside.append((container, []))
            if len(inside) > _DEEPEST:
                raise FileFormatError(f"{path} nests more than {_DEEPEST} deep, message {number}")
        elif isinstance(event, yaml.CollectionEndEvent):
            inside.pop()
    if len(whole) != 1 or not isinstance(whole[0], dict):
        raise FileFormatError(f"{path} has no fields in message {number}, expected name: value")
    return whole[0]


def _awaits(within: tuple[Any, list[str]]) -> bool:
    """Whether the next value is the name of a field."""
    container, keys = within
    return isinstance(container, dict) and not keys


def _value(text: str) -> Any:
    """A plain value; numbers stay texts, which `recordings_of_rows` reads."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    return None if text in _NONE else text
