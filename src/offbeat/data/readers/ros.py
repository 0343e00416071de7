"""ROS 1 bags, ROS 2 bags in SQLite (.db3) and MCAP, through `rosbags`.

`rosbags` opens the containers and parses the definitions of the messages; `ros_layout` decodes the
selected topics and fields, thousands of messages at once. Memory use is the result
and a few megabytes of messages that wait to be decoded, for any size of the bag.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from offbeat.data.readers import mcap_rows
from offbeat.data.readers.options import Fields, names
from offbeat.data.readers.ros_files import Bag, Connection, explained, open_bag
from offbeat.data.readers.ros_topic import Topic
from offbeat.data.signals import Recording, Signal
from offbeat.data.source import require_file, starts_with
from offbeat.errors import FileFormatError, listed, one_of, require

SUFFIXES = (".bag", ".db3", ".mcap")

_MAGIC = (b"#ROSBAG V", b"SQLite format 3\0", b"\x89MCAP0\r\n")
_APART_NS = 10**9  # difference of two clocks that is no delay
_WAITING_BYTES = 16 * 2**20  # messages that wait to be decoded

# Images, maps and texts are not channels unless they are selected.
_NOT_BY_DEFAULT = (
    "bond/",
    "diagnostic_msgs/",
    "map_msgs/",
    "nav_msgs/msg/GridCells",
    "nav_msgs/msg/OccupancyGrid",
    "nav_msgs/msg/Path",
    "offbeat_msgs/",
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
    """Whether a file has the signature of a ROS bag or MCAP, or a folder is a ROS 2 bag."""
    if path.is_dir():
        return any(
            next(path.glob(form), None) is not None
            for form in ("metadata.yaml", "*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd")
        )
    return starts_with(path, _MAGIC)


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
        topics: the topics to read; by default all whose messages contain numbers, except images,
            scans, maps, markers, logs and transforms that never change.
        fields: fields to read, such as `pose.position` (with all below it), `velocity[0]`, or
            `/odom:twist.twist` for one topic alone; by default all numbers but covariances, long
            sequences, and what the header holds.
        stamps: `header` uses the stamps of the messages' headers, and the time of receipt if
            there is none; `receive` uses the time of receipt everywhere.
        typestore: the ROS distribution whose definitions are used if a bag has none, such
            as `ros2_humble`.

    Yields:
        The recording. Sequences of numbers become a channel per element, named by the message
        if it has as many names (`position.elbow` of joint states). A list of transforms
        becomes a signal per child frame.

    Raises:
        FileFormatError: the bag is truncated or damaged, a message type is unknown, or nothing
            selected is a number.
        InputError: a topic, field or option is unknown.
        MissingExtraError: `rosbags` is not installed.
    """
    one_of("stamps", stamps, ("header", "receive"))
    topics = names("topics", topics)
    require("rosbags", "ros")
    path = Path(path)
    if not path.is_dir():
        require_file(path)
    with open_bag(path) as bag:
        if bag.connections and all(c.kind == mcap_rows.KIND for c in bag.connections):
            yield from mcap_rows.recordings(bag, path)
            return
        notes: list[str] = [*bag.notes]
        chosen = _chosen(bag.connections, topics, path, notes)
        wanted = Fields(fields, sorted({c.topic for c in chosen}))
        readers = _topic_readers(bag, chosen, wanted, typestore, path, notes, asked=bool(topics))
        _read(bag, chosen, readers, path)
    wanted.check()
    clocks = _clocks(list(readers.values()), stamps, notes)
    signals: list[Signal] = []
    for topic in readers.values():
        signals.extend(topic.signals(header=clocks[topic.name], notes=notes))
    if not signals:
        topics = listed(list(readers), 4) or "any of its topics"
        raise FileFormatError(
            f"{path} holds no numbers in {topics}; it has the topics "
            f"{_listed(bag.connections)}; choose with topics="
        )
    yield Recording(tuple(signals), origin=path.name, time_unit="ns", notes=tuple(notes))


def _listed(connections: Sequence[Connection]) -> str:
    topics = {c.topic: f"{c.topic} ({c.kind})" for c in connections}
    return listed([topics[name] for name in sorted(topics)]) or "none"


def _chosen(
    connections: Sequence[Connection], topics: Sequence[str] | None, path: Path, notes: list[str]
) -> list[Connection]:
    """The connections of the topics to read."""
    if not connections:
        raise FileFormatError(f"{path} holds no topics; record it again")
    if topics is not None:
        known = {c.topic for c in connections}
        named = {one_of(f"topic of {path.name}", topic, known) for topic in topics}
        foreign = {c.topic: c.encoding for c in connections
                   if c.encoding not in ("ros1", "cdr") and c.topic not in named}  # fmt: skip
        if foreign:
            listed = ", ".join(f"{name} ({what})" for name, what in sorted(foreign.items()))
            notes.append(f"topics without messages of ROS are left out: {listed}")
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


def _topic_readers(
    bag: Bag,
    chosen: list[Connection],
    fields: Fields,
    typestore: str,
    path: Path,
    notes: list[str],
    *,
    asked: bool,
) -> dict[str, Topic]:
    """A reader per selected topic whose messages are defined."""
    from rosbags.typesys import Stores, get_typestore

    stores = {store.value: store for store in Stores if store.value.startswith(("ros2", "latest"))}
    one_of("typestore", typestore, stores)
    base = dict(get_typestore(Stores.EMPTY).fielddefs)
    readers: dict[str, Topic] = {}
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
        cdr = connection.encoding == "cdr"
        readers[name] = Topic(name, kind, definitions, cdr, fields, optional=not asked)
    if assumed:
        notes.append(
            f"the bag does not define the messages of {', '.join(assumed)}; the definitions of "
            f"the typestore {typestore} are taken (typestore= names another)"
        )
    return readers


def _read(bag: Bag, chosen: list[Connection], readers: dict[str, Topic], path: Path) -> None:
    """Passes the messages of the chosen topics to their readers in batches."""
    batches = {c.id: readers[c.topic] for c in chosen if c.topic in readers}
    waiting = 0
    try:
        for number, received, message in bag.messages(set(batches)):
            batch = batches[number]
            batch.times.append(received)
            batch.messages.append(message)
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


def _unmet(topics: list[Topic]) -> tuple[str, str] | None:
    """Two topics whose header clocks have no time in common while they were received together."""
    spans = sorted(((*t.span(header=True), t) for t in topics), key=lambda span: span[:2])
    for i in range(1, len(spans)):
        latest = max(span[1] for span in spans[:i])
        if spans[i][0] <= latest:
            continue
        one = max(spans[:i], key=lambda span: span[1])[2]
        if abs(spans[i][2].offset() - one.offset()) > _APART_NS:
            return one.name, spans[i][2].name
    return None


def _clocks(topics: list[Topic], stamps: str, notes: list[str]) -> dict[str, bool]:
    """Whether each topic uses the stamps of its headers.

    Topics without a header have only the time of receipt. If that clock and the one of the
    headers do not overlap (a simulator's clock, a replayed bag), all use the time of
    receipt: merged signals need one clock.
    """
    chosen = {t.name: stamps == "header" and t.has_header for t in topics}
    if stamps == "receive":
        return chosen
    filled = [t for t in topics if t.parts]
    stuck = [t.name for t in filled if chosen[t.name] and t.is_stuck]
    if stuck:
        chosen |= dict.fromkeys(stuck, False)
        notes.append(f"header stamps repeat, and times of receipt are taken, in {', '.join(stuck)}")
    headed = [t for t in filled if chosen[t.name]]
    without = [t for t in filled if not chosen[t.name]]
    unmet = _unmet(headed)
    if unmet:
        notes.append(
            f"stamps are times of receipt: the clocks of the headers of {unmet[0]} and of "
            f"{unmet[1]} have no time in common"
        )
        return dict.fromkeys(chosen, False)
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
            "stamps are times of receipt, because there is no header stamp, in "
            + ", ".join(t.name for t in without)
        )
    return chosen
