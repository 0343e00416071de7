"""Data frames of pandas: round trips, and what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import offbeat as ob
from offbeat.data.frames import from_pandas, to_pandas


def made() -> ob.Dataset:
    values = np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, 5.0]])
    one = ob.Trajectory(
        [0.5, 0.75, 2.0], values, names=("hip", "u"), units=("rad", "N"), roles=("state", "action")
    )
    return ob.Dataset((one, one.slice(1, 3)))


def test_without_pandas_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ob.MissingExtraError, match="pip install pandas"):
        to_pandas(made())


class TestWithPandas:
    @pytest.fixture(autouse=True)
    def pandas(self):
        return pytest.importorskip("pandas")

    def test_a_data_set_comes_back(self, pandas):
        frame = to_pandas(made())
        assert list(frame.columns) == ["trajectory", "time", "hip", "u"]
        assert from_pandas(frame).fingerprint() == made().fingerprint()
        frame.attrs.clear()
        again = from_pandas(frame, units={"hip": "rad", "u": "N"}, roles={"u": "action"})
        assert again.fingerprint() == made().fingerprint()

    def test_masked_values_are_missing_in_the_frame(self, pandas):
        masked = ob.mask_out(made(), 0.5, mask="values")
        frame = to_pandas(masked)
        assert frame["hip"].notna().sum() == sum(int(t.observed[:, 0].sum()) for t in masked)

    def test_time_stamps_lose_no_nanosecond_and_count_from_the_first_row(self, pandas):
        stamps = pandas.to_datetime([10**18 + 7, 10**18 + 10, 10**18 + 12], utc=True)
        frame = pandas.DataFrame({"at": stamps, "run": ["b", "a", "b"], "x": [1, 2, 3]})
        data = from_pandas(frame, time="at", by="run")
        assert [t.times.tolist() for t in data] == [[0.0, 5e-9], [0.0]]
        assert [t.values[:, 0].tolist() for t in data] == [[1.0, 3.0], [2.0]]

    def test_what_does_not_fit_is_refused(self, pandas):
        frame = to_pandas(made())
        for options, message in (
            ({"time": "t"}, "unknown column of times 't'"),
            ({"by": "run"}, "unknown column of trajectories 'run'"),
            ({"units": {"foot": "m"}}, "unknown channel in units 'foot'"),
        ):
            with pytest.raises(ob.InputError, match=message):
                from_pandas(frame, **options)
        with pytest.raises(ob.InputError, match="must be numbers"):
            from_pandas(frame.assign(hip="a"))
