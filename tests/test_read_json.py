"""JSON as tables, Feather, structs of Parquet, and logs of ArduPilot in text."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
import pytest
from corpus.tables import NS, ROWS, TIMES, X, Y

from offbeat.data.readers import read
from offbeat.errors import FileFormatError

ROWS_OF = [{"t": t, "pose": {"x": x}, "q": [x, y], "mode": "a"} for t, x, y in zip(
    TIMES.tolist(), X.tolist(), Y.tolist(), strict=True)]  # fmt: skip
PLAIN = [{"t": row["t"], "x": row["pose"]["x"]} for row in ROWS_OF]


def notes(dataset):
    return "\n".join(dataset.meta["cleaning"]["notes"])


def lines(rows):
    return "".join(json.dumps(row) + "\n" for row in rows)


JSON = {
    "lines": lines(PLAIN),
    "lines of texts": lines({"t": str(row["t"]), "x": str(row["x"])} for row in PLAIN),
    "lines of MongoDB": lines(
        {"t": {"$numberDouble": str(row["t"])}, "x": {"$numberDouble": str(row["x"])}}
        for row in PLAIN
    ),
    "lines with gaps between": lines(PLAIN).replace("\n", "\n\n"),
    "an array": json.dumps(PLAIN),
    "an array over lines": json.dumps(PLAIN, indent=2),
    "columns": json.dumps({"t": TIMES.tolist(), "x": X.tolist()}),
    "columns by index": json.dumps({"t": dict(enumerate(TIMES.tolist())),
                                    "x": dict(enumerate(X.tolist()))}),
    "split": json.dumps({"columns": ["t", "x"], "data": [list(r.values()) for r in PLAIN]}),
    "rows by index": json.dumps(dict(enumerate(PLAIN))),
    "rows in an object": json.dumps({"robot": "g1", "samples": PLAIN}),
}  # fmt: skip


@pytest.mark.parametrize("form", JSON)
@pytest.mark.parametrize("suffix", [".json", ".jsonl", ".json.gz"])
def test_json_of_any_form_is_a_table(form, suffix, tmp_path):
    path = tmp_path / f"log{suffix}"
    text = JSON[form].encode()
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    (trajectory,) = dataset = read(path)
    assert dataset.names == ("x",)
    assert trajectory.times == pytest.approx(TIMES, abs=1e-12)
    assert trajectory.values[:, 0].tolist() == X.tolist()


def test_objects_in_objects_and_lists_are_columns(tmp_path):
    (tmp_path / "log.jsonl").write_text(lines(ROWS_OF))
    (trajectory,) = dataset = read(tmp_path / "log.jsonl")
    assert dataset.names == ("pose.x", "q[0]", "q[1]")
    assert trajectory.values.tolist() == np.column_stack([X, X, Y]).tolist()
    assert "'mode'" in notes(dataset)


def test_nanoseconds_keep_every_digit(tmp_path):
    rows = [{"time_ns": int(t), "x": x} for t, x in zip(NS + np.arange(ROWS), X, strict=True)]
    (tmp_path / "log.jsonl").write_text(lines(rows))
    expected = (NS + np.arange(ROWS) - NS[0]) / 1e9
    assert read(tmp_path / "log.jsonl")[0].times.tolist() == expected.tolist()


def test_messages_of_a_type_have_columns_of_their_own(tmp_path):
    rows = [
        {"meta": {"type": kind, "timestamp": 1_764_000_000 + float(t)}, "data": {field: x}}
        for t, x in zip(TIMES, X, strict=True)
        for kind, field in (("IMU", "x"), ("BAT", "Volt"))
    ]
    (tmp_path / "log.json").write_text(lines(rows))
    (trajectory,) = dataset = read(tmp_path / "log.json")
    assert dataset.names == ("IMU.data.x", "BAT.data.Volt")
    assert trajectory.values.tolist() == np.column_stack([X, X]).tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lines(PLAIN[:5]) + "[1]\n" + lines(PLAIN[5:]), r"has '\[1\]' in line 6, expected an obj"),
        ("[" * 5000, "is no JSON"),
        (json.dumps([1, 2, 3]), "has '1' in row 0, expected an object"),
        (lines([{"a": {}}] * 3), "no channels|no column of times"),
        ("{}\n{}\n", "no column of times|no channels"),
        (
            lines({**row, "x": "err" if i == 3 else row["x"]} for i, row in enumerate(PLAIN)),
            r"has 'err' in row 3, 'x', expected a number; leave the column out with without=",
        ),
        (json.dumps(json.loads("[" * 30 + "]" * 30)), "in row 0, expected an object"),
    ],
)
def test_other_json_is_refused_in_one_line(text, message, tmp_path):
    (tmp_path / "log.jsonl").write_text(text)
    with pytest.raises(FileFormatError, match=message) as error:
        read(tmp_path / "log.jsonl")
    assert "\n" not in str(error.value)


def test_a_last_line_that_is_cut_off_is_left_out(tmp_path):
    (tmp_path / "log.jsonl").write_text(lines(PLAIN)[:-9])
    dataset = read(tmp_path / "log.jsonl")
    assert dataset[0].rows == ROWS - 1
    assert "the last line is cut off" in notes(dataset)


def test_metadata_beside_logs_is_no_log(tmp_path):
    (tmp_path / "a.csv").write_text("time,x\n0,1\n1,2\n")
    (tmp_path / "meta.json").write_text('{"robot": "g1", "rate": {"hz": 50}}')
    assert read(tmp_path)[0].rows == 2


STRUCTS = pa.table(
    {
        "header": [{"stamp": {"sec": int(t // 10**9), "nanosec": int(t % 10**9)}} for t in NS],
        "pose": [None if i == 3 else {"x": x, "in": {"y": y}} for i, (x, y) in
                 enumerate(zip(X, Y, strict=True))],
    }
)  # fmt: skip


@pytest.mark.parametrize("form", ["parquet", "feather", "feather plain", "arrow"])
def test_fields_of_structs_are_columns(form, tmp_path):
    path = tmp_path / f"log.{form.partition(' ')[0]}"
    if form == "parquet":
        pq.write_table(STRUCTS, path, row_group_size=7)
    elif form == "arrow":
        with pa.ipc.new_stream(path, STRUCTS.schema) as writer:
            writer.write_table(STRUCTS, max_chunksize=9)
    else:
        feather.write_feather(
            STRUCTS, path, compression="uncompressed" if "plain" in form else "lz4"
        )
    (trajectory,) = dataset = read(path)
    assert dataset.names == ("pose.x", "pose.in.y")
    assert trajectory.times == pytest.approx(TIMES, abs=1e-12)
    expected = np.column_stack([X, Y])
    expected[3] = np.nan
    np.testing.assert_array_equal(trajectory.values, expected)


FMT = """FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 31, PARM, QNf, TimeUS,Name,Value
FMT, 3, 40, IMU, QBff, TimeUS,I,GyrX,AccZ
FMT, 4, 40, ATT, Qcc, TimeUS,Roll,Yaw
FMT, 5, 40, MSG, QZ, TimeUS,Message
"""


def dataflash():
    rows = "".join(
        f"IMU, {20_000 * i}, {k}, {x + k}, -9.8\n" for i, x in enumerate(X) for k in range(2)
    )
    turns = "".join(f"ATT, {20_000 * i}, {x}, {(350 + i) % 360}\n" for i, x in enumerate(X))
    return FMT + rows + turns + "MSG, 7, one, two\nPARM, 7, RATE, 3.0\n"


@pytest.mark.parametrize("suffix", [".log", ".txt", ".csv", ".log.gz"])
def test_a_text_log_of_ardupilot(suffix, tmp_path):
    path = tmp_path / f"log{suffix}"
    text = dataflash().encode()
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    (trajectory,) = dataset = read(path)
    assert dataset.names == (
        *("IMU[0].GyrX", "IMU[0].AccZ", "IMU[1].GyrX", "IMU[1].AccZ", "ATT.Roll", "ATT.Yaw"),
    )
    assert dataset.units == ("rad/s", "m/s2", "rad/s", "m/s2", "deg", "deg")
    assert trajectory.times == pytest.approx(TIMES, abs=1e-9)
    assert trajectory.values[:, 2].tolist() == (X + 1).tolist()
    assert trajectory.values[:, 5].tolist() == (350.0 + np.arange(ROWS)).tolist()  # unwrapped
    assert "PARM" in notes(dataset)


def test_messages_and_fields_of_ardupilot_are_chosen(tmp_path):
    (tmp_path / "log.log").write_text(dataflash() + "IMU, 9")
    assert read(tmp_path / "log.log", topics=["ATT"]).names == ("Roll", "Yaw")
    dataset = read(tmp_path / "log.log", fields=["IMU:GyrX"])
    assert dataset.names == ("IMU[0].GyrX", "IMU[1].GyrX")
    assert "ends in the middle of a line" in notes(dataset)
    (tmp_path / "log.log").write_text(dataflash() + "IMU, 9\nIMU, 900, 0, 1, 2\n")
    with pytest.raises(FileFormatError, match="has 1 fields of IMU, expected as many as its FMT"):
        read(tmp_path / "log.log")


def test_what_mavlogdump_prints(tmp_path):
    text = "".join(
        f"2026-07-28 14:03:02.12: IMU {{TimeUS : {20_000 * i}, GyrX : {x}, Name : a b}}\n"
        for i, x in enumerate(X)
    )
    (tmp_path / "log.log").write_text(text)
    (trajectory,) = dataset = read(tmp_path / "log.log")
    assert dataset.names == ("GyrX",)
    assert trajectory.values[:, 0].tolist() == X.tolist()


@pytest.mark.parametrize(
    ("suffix", "message"),
    [(".bin", "mavlogdump.py LOG.bin"), (".tlog", "mavlogdump.py --format csv"), (".xlsx", "CSV")],
)
def test_a_format_that_is_not_read_names_how_to_convert_it(suffix, message, tmp_path):
    (tmp_path / f"log{suffix}").write_bytes(b"PK\3\4 and so on")
    with pytest.raises(FileFormatError, match=message):
        read(tmp_path / f"log{suffix}")


ECHO = """header:
  seq: {i}
  stamp:
    secs: 1700000000
    nsecs: {nsecs}
  frame_id: "base: [0, 1]"
angle: {angle}
ready: {ready}
quaternion: [0.0, 1e-05, {angle}, 1.0]
note: ''
---
"""


@pytest.mark.parametrize("suffix", [".yaml", ".txt", ".log", ".txt.gz"])
def test_messages_that_rostopic_printed(suffix, tmp_path):
    text = "".join(
        ECHO.format(i=i, nsecs=10_000_000 * i, angle=0.1 * i, ready=i % 2 == 0) for i in range(20)
    )
    text += "header:\n  seq: 20\n  sta"  # the printing was stopped
    path = tmp_path / f"echo{suffix}"
    path.write_bytes(gzip.compress(text.encode()) if suffix.endswith("gz") else text.encode())
    (trajectory,) = (dataset := read(path))
    assert trajectory.times == pytest.approx(0.01 * np.arange(20), abs=1e-9)
    channel = dict(zip(trajectory.names, trajectory.values.T, strict=True))
    np.testing.assert_allclose(channel["angle"], 0.1 * np.arange(20))
    np.testing.assert_array_equal(channel["ready"], np.arange(20) % 2 == 0)
    assert channel["quaternion[1]"][0] == 1e-05
    assert any("last message" in note for note in dataset.meta["cleaning"]["notes"])


@pytest.mark.parametrize(
    "message",
    [
        "a: &x [1, 2]\nb: *x",
        "a: " + 30 * "[" + 30 * "]",
        30 * "- " + "1",
        "a: [1",
        "just text",
        "a: 1\n...\nb: 2",
        "a: !!python/object/apply:os.system ['true']",
        "a: " + 300_000 * "1",
        "",
    ],
)
def test_hostile_messages_end_in_one_line(message, tmp_path):
    path = tmp_path / "echo.yaml"
    path.write_text(f"{message}\n---\n{message}\n---\n")
    with pytest.raises(FileFormatError) as caught:
        read(path, format="ros_echo", rate_hz=10)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
