"""Arrays in groups: plain HDF5, ALOHA, D4RL, MATLAB and arrays of NumPy."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from corpus import groups
from corpus.tables import ROWS, TIMES, X, Y
from scipy import io as scipy_io

from offbeat.data.readers import read
from offbeat.errors import FileFormatError

pytest.importorskip("h5py")


def notes(dataset):
    return "\n".join(dataset.meta["cleaning"]["notes"])


@pytest.mark.parametrize("kind", groups.HDF5)
def test_plain_hdf5_has_the_times_and_values_that_it_means(kind, tmp_path):
    (trajectory,) = dataset = read(groups.of_kind(tmp_path / "log.h5", kind))
    assert dataset.names == groups.HDF5[kind][2]
    assert trajectory.times == pytest.approx(TIMES, abs=1e-9)
    assert trajectory.values.tolist() == np.column_stack([X, Y]).tolist()
    if kind == "times of a unit in an attribute":
        assert dataset.units == ("m", "")


def test_sensors_with_clocks_of_their_own_are_merged(tmp_path):
    (trajectory,) = dataset = read(groups.two_clocks(tmp_path / "log.h5"))
    assert dataset.names == ("foot.load", "imu.acc[0]", "imu.acc[1]")
    assert trajectory.rows == 2 * ROWS
    assert trajectory.values[0::2, 1].tolist() == X.tolist()
    assert trajectory.values[1::2, 0].tolist() == (10 * X).tolist()
    with pytest.raises(FileFormatError, match=r"clocks that never meet, in 'foot' and 'imu'"):
        read(groups.two_clocks(tmp_path / "log.h5", shift=1e6))
    assert read(tmp_path / "log.h5", keys=["foot"]).names == ("load",)


def test_an_episode_of_aloha(tmp_path):
    (trajectory,) = dataset = read(groups.aloha(tmp_path / "episode_0.hdf5"), rate_hz=50)
    assert dataset.names == ("action[0]", "action[1]", "qpos[0]", "qpos[1]")
    assert dataset.roles == ("action", "action", "state", "state")
    assert trajectory.times == pytest.approx(TIMES, abs=1e-9)
    assert trajectory.values[:, 2:].tolist() == groups.XY.tolist()
    assert "observations/images/top (4 x 5 x 3)" in notes(dataset)
    assert "1 s apart" in notes(read(tmp_path / "episode_0.hdf5"))
    without = read(tmp_path / "episode_0.hdf5", include_actions=False, rate_hz=50)
    assert without.names == ("qpos[0]", "qpos[1]")


def test_episodes_of_d4rl_end_at_terminals_and_timeouts(tmp_path):
    dataset = read(groups.d4rl(tmp_path / "log.hdf5"), rate_hz=50)
    assert [trajectory.rows for trajectory in dataset] == [10, 15, ROWS - 25]
    assert dataset.names == ("actions", "observations[0]", "observations[1]")
    assert dataset.roles == ("action", "state", "state")
    assert dataset[1].values[:, 2].tolist() == Y[10:25].tolist()
    assert dataset[1].times == pytest.approx(TIMES[:15], abs=1e-9)
    assert "next_observations" in notes(dataset)


@pytest.mark.parametrize(
    "names", [["traj_0", "traj_2", "traj_10"], ["0", "1"], ["data/Trial 1", "data/Trial 2"]]
)
def test_groups_of_episodes_are_episodes(names, tmp_path):
    dataset = read(groups.episodes(tmp_path / "log.h5", names))
    assert dataset.meta["labels"] == [name.rpartition("/")[2] for name in names]
    assert dataset.names == ("imu/x", "y")
    for i, trajectory in enumerate(dataset):
        assert trajectory.values[:, 0].tolist() == (X + i).tolist()


def test_groups_of_sensors_are_no_episodes(tmp_path):
    (_,) = dataset = read(groups.episodes(tmp_path / "log.h5", ["imu_0", "imu_1"]))
    assert dataset.names == ("imu_0.imu/x", "imu_0.y", "imu_1.imu/x", "imu_1.y")


def test_matlab_7_3_stores_axes_in_reverse_order(tmp_path):
    (trajectory,) = dataset = read(groups.matlab_73(tmp_path / "log.mat"))
    assert dataset.names == ("q[0]", "q[1]", "x")
    assert trajectory.times == pytest.approx(TIMES, abs=1e-9)
    assert trajectory.values.tolist() == np.column_stack([X, Y, X]).tolist()


def test_a_first_block_that_names_a_driver_is_refused_before_it_is_allocated(tmp_path):
    path = groups.of_kind(tmp_path / "log.h5", "times beside a matrix")
    raw = bytearray(path.read_bytes())
    assert raw[8] == 0  # the version of the first block
    struct.pack_into("<Q", raw, 24 + 3 * 8, 96)
    path.write_bytes(raw)
    with pytest.raises(FileFormatError, match="one of several parts of an HDF5 file"):
        read(path)


@pytest.mark.parametrize("form", ["4", "5"])
@pytest.mark.parametrize("axis", ["row", "column"])
@pytest.mark.parametrize("pack", [False, True])
def test_matlab_has_times_along_either_axis(form, axis, pack, tmp_path):
    matrix = groups.XY if axis == "column" else groups.XY.T
    values = {"t": TIMES, "q": matrix, "name": "robot"}
    packed = pack and form == "5"
    scipy_io.savemat(tmp_path / "log.mat", values, format=form, oned_as=axis, do_compression=packed)
    (trajectory,) = dataset = read(tmp_path / "log.mat")
    assert dataset.names == ("q[0]", "q[1]")
    assert trajectory.times == pytest.approx(TIMES, abs=1e-9)
    assert trajectory.values.tolist() == groups.XY.tolist()
    assert "name" in notes(dataset)


def test_structs_of_matlab_are_groups(tmp_path):
    log = {"imu": {"t": TIMES, "acc": groups.XY}, "foot": {"t": TIMES + 0.01, "f": X}}
    scipy_io.savemat(tmp_path / "log.mat", {"log": log})
    dataset = read(tmp_path / "log.mat")
    assert dataset.names == ("log.imu.acc[0]", "log.imu.acc[1]", "log.foot.f")
    assert dataset[0].rows == 2 * ROWS
    scipy_io.savemat(tmp_path / "log.mat", {"text": "abc"})
    with pytest.raises(FileFormatError, match=r"no array of numbers; .*t = x.Time; y = x.Data"):
        read(tmp_path / "log.mat")


def test_fields_of_an_array_of_numpy_are_channels(tmp_path):
    kind = [("time", "f8"), ("q", "f8", (2,)), ("pose", [("x", "f8"), ("y", "f8")])]
    array = np.zeros(ROWS, dtype=kind)
    array["time"], array["q"], array["pose"]["x"] = TIMES, groups.XY, X
    np.save(tmp_path / "log.npy", array)
    (trajectory,) = dataset = read(tmp_path / "log.npy")
    assert dataset.names == ("q.0", "q.1", "pose.x", "pose.y")
    assert trajectory.values[:, :3].tolist() == np.column_stack([X, Y, X]).tolist()
    np.save(tmp_path / "log.npy", groups.XY)
    with pytest.raises(FileFormatError, match=r"one array of shape .* without names; write named"):
        read(tmp_path / "log.npy")
    np.save(tmp_path / "log.npy", np.array([{}, 1], dtype=object))
    with pytest.raises(FileFormatError, match="holds pickled Python objects"):
        read(tmp_path / "log.npy")


def test_structs_in_an_array_of_matlab_are_episodes(tmp_path):
    runs = [{"t": TIMES, "x": X + i} for i in range(3)]
    scipy_io.savemat(tmp_path / "log.mat", {"run": runs})
    dataset = read(tmp_path / "log.mat")
    assert dataset.meta["labels"] == ["0", "1", "2"]
    assert [t.values[:, 0].tolist() for t in dataset] == [(X + i).tolist() for i in range(3)]


def test_matlab_may_state_a_rate_or_times_as_text(tmp_path):
    for name, value in (("Fs", 50.0), ("dt", 0.02)):
        scipy_io.savemat(tmp_path / "log.mat", {"x": X, name: value})
        dataset = read(tmp_path / "log.mat")
        assert dataset[0].times == pytest.approx(TIMES, abs=1e-9)
        assert f"row number / 50 Hz, as {name!r} says" in notes(dataset)
    scipy_io.savemat(tmp_path / "log.mat", {"x": X, "version": 3.0, "dt": 1e12})
    with pytest.raises(FileFormatError, match="has no array of times"):
        read(tmp_path / "log.mat")
    texts = np.array([f"2026-07-28 14:03:{i:02d}" for i in range(ROWS)])
    scipy_io.savemat(tmp_path / "log.mat", {"time": texts, "x": X})
    assert read(tmp_path / "log.mat")[0].times.tolist() == list(range(ROWS))


def test_quaternions_of_groups_are_made_continuous(tmp_path):
    turns = np.column_stack([0 * X, 0 * X, np.sin(X), np.cos(X)])
    turns[20:] *= -1
    path = groups.written(tmp_path / "log.h5", {"time": TIMES, "base_quat": turns})
    (trajectory,) = dataset = read(path)
    assert (np.abs(np.diff(trajectory.values, axis=0)) < 0.5).all()
    assert dataset.meta["cleaning"]["quaternions"]
