"""Formats that data sets are written in, and a format from outside the package."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest

import offbeat as ob
from offbeat.data.writers import WRITERS, register_writer, save


def made(**meta) -> ob.Dataset:
    random = np.random.default_rng(0)
    trajectories = []
    for rows in (5, 3):
        values = random.normal(size=(rows, 2))
        values[1, 0] = np.nan
        times = np.arange(rows) / 8
        trajectories.append(ob.Trajectory(times, values, names=("hip", "knee"), units=("rad", "")))
    return ob.Dataset(tuple(trajectories), meta)


@pytest.mark.parametrize("name", ["walk.csv", "walk.pq"])
@pytest.mark.parametrize("labels", [["a", "b"], None])
def test_a_table_that_is_read_back_has_the_same_times_values_names_and_units(
    tmp_path, name, labels
):
    data = made(**({"labels": labels} if labels else {}))
    save(data, tmp_path / name)
    again = ob.read(tmp_path / name)
    assert again.fingerprint() == data.fingerprint()
    assert again.meta["labels"] == (labels or ["0", "1"])


def test_columns_are_called_by_channel_and_unit(tmp_path):
    save(made(), tmp_path / "walk.pq")
    names = pq.read_schema(tmp_path / "walk.pq").names
    assert names == ["trajectory", "time", "hip [rad]", "knee"]


def test_the_suffix_parquet_is_the_own_format(tmp_path):
    masked = ob.mask_out(made(), 0.5)
    save(masked, tmp_path / "walk.parquet")
    assert ob.load(tmp_path / "walk.parquet").fingerprint() == masked.fingerprint()
    save(masked, tmp_path / "walk.data", format="offbeat")
    assert ob.load(tmp_path / "walk.data").fingerprint() == masked.fingerprint()


def test_a_format_of_another_package_is_written_and_read(tmp_path):
    register_writer("rows", lambda data, path: None, suffixes=(".n",))
    try:
        register_writer(
            "rows",
            lambda data, path: path.write_text(str(data[0].rows)),
            suffixes=(".n",),
            replace=True,
        )
        ob.save(made(), tmp_path / "walk.n")
        assert (tmp_path / "walk.n").read_text() == "5"
    finally:
        WRITERS.unregister("rows")


def test_unknown_formats_and_names_that_collide_are_refused(tmp_path):
    with pytest.raises(
        ob.InputError, match=r"suffix '.xls', expected one of: offbeat \(.parquet\)"
    ):
        save(made(), tmp_path / "walk.xls")
    with pytest.raises(ob.InputError, match="did you mean 'csv'"):
        save(made(), tmp_path / "walk", format="cvs")
    clash = ob.Dataset((ob.Trajectory([0.0], [[1.0]], names=("time",)),))
    with pytest.raises(ob.InputError, match="would have the name 'time'"):
        save(clash, tmp_path / "walk.csv")


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_every_format_keeps_times_values_names_and_units(tmp_path, name):
    path = tmp_path / f"walk{WRITERS[name].suffixes[0]}"
    save(made(), path, format=name)
    again = ob.read(path)
    assert (again.names, again.units) == (made().names, made().units)
    for a, b in zip(again, made(), strict=True):
        assert a.times.tolist() == b.times.tolist()
        assert np.array_equal(a.values, b.values, equal_nan=True)
