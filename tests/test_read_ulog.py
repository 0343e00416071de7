"""PX4 flight logs."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import robot_logs as logs
from pyulog import ULog
from real_logs import shared

from offbeat.data.readers import read, ulog
from offbeat.errors import FileFormatError, InputError, MissingExtraError

FORMATS = {
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint8_t[4] _padding0;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "battery": "uint64_t timestamp;float voltage_v;bool connected;char[3] serial;",
}


def gyro(t, x=0.0):
    return "sensor_combined", 0, (t, x, 0.5, 0.25, 4000, -7, 1.0, 2.0, 9.75)


def attitude(t, q=(1.0, 0.0, 0.0, 0.0)):
    return "vehicle_attitude", 0, (t, *q)


def battery(t, volts, instance=0):
    return "battery", instance, (t, volts, True, b"a", b"b", b"c")


ROWS = [
    gyro(1000, 1.0),
    attitude(1500),
    battery(1600, 12.5),
    battery(1700, 11.5, 1),
    gyro(5000, 2.0),
    attitude(9000, (0.0, 1.0, 0.0, 0.0)),
]


@pytest.fixture
def write(tmp_path):
    def written(rows=ROWS, **options):
        path = tmp_path / "log.ulg"
        path.write_bytes(logs.ulog_bytes(FORMATS, rows, **options))
        return path

    return written


def one(path, **options):
    (recording,) = ulog.recordings(path, **options)
    return recording


def refused(path, message, error=FileFormatError, **options):
    with pytest.raises(error, match=message) as caught:
        one(path, **options)
    assert "\n" not in str(caught.value)


def test_every_topic_has_its_own_stamps_in_microseconds(write):
    recording = one(write())
    assert [s.name for s in recording.signals] == ["sensor_combined", "vehicle_attitude"]
    gyros, attitudes = recording.signals
    assert gyros.stamps.tolist() == [1_000_000, 5_000_000]
    assert attitudes.stamps.tolist() == [1_500_000, 9_000_000]
    assert recording.time_unit == "us"
    assert gyros.values.tolist() == [
        [1.0, 0.5, 0.25, 1.0, 2.0, 9.75],
        [2.0, 0.5, 0.25, 1.0, 2.0, 9.75],
    ]
    assert gyros.channels[0] == "gyro_rad[0]"
    assert gyros.units == ("rad/s",) * 3 + ("m/s^2",) * 3
    assert attitudes.kinds == ("quaternion",) * 4


def test_topics_are_merged_on_the_union_of_their_stamps(write):
    (trajectory,) = read(write())
    assert trajectory.times.tolist() == [0.0, 0.0005, 0.004, 0.008]
    assert trajectory.observed.sum(axis=1).tolist() == [6, 4, 6, 4]
    assert trajectory.names[-1] == "vehicle_attitude.q[3]"


def test_what_is_left_out_is_said(write):
    notes = one(write()).notes
    assert notes == ("left out unless chosen with topics=: battery",)


def test_topics_instances_and_fields_are_chosen(write):
    path = write()
    first, second = one(path, topics=["battery"]).signals
    assert (first.name, second.name) == ("battery", "battery_1")
    assert first.channels == ("voltage_v", "connected")  # no text
    assert second.values.tolist() == [[11.5, 1.0]]
    (signal,) = one(path, topics=["battery:1"]).signals
    assert signal.name == "battery_1"
    gyros = one(path, topics=["sensor_combined"]).signals[0]
    assert gyros.channels[3] == "gyro_integral_dt"  # all numbers, but for stamps and padding
    assert len(gyros.channels) == 7
    assert one(path, fields=["gyro_rad[1]"]).signals[0].channels == ("gyro_rad[1]",)
    (signal,) = one(
        path, topics=["battery", "vehicle_attitude"], fields=["vehicle_attitude:q"]
    ).signals
    assert signal.channels == ("q[0]", "q[1]", "q[2]", "q[3]")


def test_the_topics_instances_and_fields_that_there_are_are_listed(write):
    path = write()
    known = "'gps', expected one of: battery, sensor_combined, vehicle_attitude"
    refused(path, known, InputError, topics=["gps"])
    refused(
        path, "instance of battery '4', expected one of: 0, 1", InputError, topics=["battery:4"]
    )
    refused(path, "'qq', expected one of: .*gyro_rad.*q", InputError, fields=["qq"])
    refused(path, "field 'gps:lat' 'gps'", InputError, fields=["gps:lat"])
    only = write([battery(1, 12.0)])
    refused(only, r"none of the topics that are read by default.*choose.*from: battery$")


def test_logged_dropouts_are_noted(write):
    note = one(write(dropouts={2: 30, 5: 112})).notes[0]
    assert note == (
        "the autopilot logged 2 dropouts, 142 ms in total, the longest of 112 ms at 0.004 s"
    )


def test_a_log_that_was_cut_off_is_read_up_to_there(write):
    path = write()
    whole = path.read_bytes()
    last = 3 + 2 + 8 + 16  # header, number, stamp and q
    for lost in range(1, last):
        path.write_bytes(whole[:-lost])
        recording = one(path)
        assert "cut off in the middle of a message" in recording.notes[0]
        assert [len(s.stamps) for s in recording.signals] == [2, 1]
    path.write_bytes(whole[:-last])  # between two messages: nothing can be told
    assert one(path).notes == one(write(ROWS[:-1])).notes


@pytest.mark.parametrize("length", [1, 10, 16, 40, 100])
def test_a_log_without_any_data_is_refused(write, length):
    path = write()
    path.write_bytes(path.read_bytes()[:length])
    refused(path, "can't be read as a ULog|cut off before any data")


def test_damage_in_the_middle_is_noted_and_printed_nowhere(write, capsys):
    path = write([gyro(1000 + i) for i in range(200)])
    raw = bytearray(path.read_bytes())
    at = len(raw) // 2
    raw[at : at + 200] = b"\x07" * 200
    path.write_bytes(raw)
    notes = one(path).notes
    assert any("the file is damaged" in note for note in notes)
    assert capsys.readouterr().out == ""


def test_a_stamp_that_no_clock_shows_is_left_out_and_said(write):
    recording = one(write([gyro(1000), gyro(2**63), gyro(3000)]))
    assert recording.signals[0].stamps.tolist() == [1_000_000, 3_000_000]
    assert "sensor_combined: 1 rows with a damaged stamp are left out" in recording.notes


def test_a_pointer_of_git_lfs_says_so(tmp_path):
    path = tmp_path / "a.ulg"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 130\n")
    refused(path, "git lfs pull")


def test_without_the_extra_says_which_one(write, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    refused(write(), r"offbeat\[px4\]", MissingExtraError)


@pytest.mark.parametrize("name", ["sample.ulg", "sample_log_small.ulg"])
def test_a_log_of_px4_reads_as_pyulog_reads_it(name):
    path = shared("px4_ulog", name)
    expected = {d.name: d for d in ULog(str(path)).data_list if d.multi_id == 0}
    recording = one(path)
    assert {"sensor_combined", "vehicle_attitude"} <= {s.name for s in recording.signals}
    for signal in recording.signals:
        data = expected[signal.name].data
        assert signal.stamps.tolist() == (data["timestamp"].astype(np.int64) * 1000).tolist()
        for channel, values in zip(signal.channels, signal.values.T, strict=True):
            assert np.array_equal(values, data[channel].astype(np.float64))


def test_the_anomalies_of_a_real_log_are_what_its_readme_says():
    recording = one(shared("px4_ulog", "sample.ulg"))
    gyros = next(s for s in recording.signals if s.name == "sensor_combined")
    assert len(gyros.stamps) == 17_070
    assert np.diff(gyros.stamps).max() / 1e9 == pytest.approx(0.065, abs=0.002)
    assert any("logged 4 dropouts" in note for note in recording.notes)
