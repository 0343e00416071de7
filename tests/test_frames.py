"""Data frames of pandas: round trips, and what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

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

    def test_with_masks_everything_comes_back(self, pandas):
        masked = ob.mask_out(made(), 0.5, mask="values", seed=1)
        frame = to_pandas(masked, masks=True)
        assert frame["hip|observed"].tolist() == [
            x for t in masked for x in t.observed[:, 0].tolist()
        ]
        assert from_pandas(frame).fingerprint() == masked.fingerprint()

    def test_a_trajectory_is_a_frame_with_its_times_as_index(self, pandas):
        frames = [to_pandas(t, masks=True) for t in made()]
        assert frames[0].index.name == "time"
        assert frames[0].index.tolist() == [0.5, 0.75, 2.0]
        assert frames[1].loc[0.75, "u"] == 3.0
        assert from_pandas(frames).fingerprint() == made().fingerprint()

    def test_xarray_takes_such_a_frame(self):
        xarray = pytest.importorskip("xarray")
        data = to_pandas(made()[0]).to_xarray()
        assert isinstance(data, xarray.Dataset)
        assert data["hip"].dims == ("time",)

    def test_answers_have_columns_of_their_intervals(self, pandas):
        times = np.arange(0, 4, 0.02)
        logs = [ob.Trajectory(times, np.sin((2 + i / 9) * times)[:, None], names=("hip",))
                for i in range(8)]  # fmt: skip
        parts = ob.Dataset(tuple(logs[:5])), ob.Dataset(tuple(logs[5:]))
        simple = {"causal": ("last_value",), "two_sided": ("linear",)}
        blend = ob.fit_blend(*parts, count=30, **simple)
        filled = ob.impute(blend, ob.mask_out(parts[1], 0.5, mask="values"))
        frame = to_pandas(filled, masks=True, level=0.8)
        low, high = filled[1].interval(0.8)
        own = frame[frame["trajectory"] == 1]
        assert own["hip|low"].tolist() == low[:, 0].tolist()
        assert own["hip|high"].tolist() == high[:, 0].tolist()
        again = from_pandas(frame)
        assert again.names == ("hip",)
        assert again[1].observed.tolist() == filled[1].observed.tolist()
        with pytest.raises(ob.InputError, match="have no intervals"):
            to_pandas(parts[0], level=0.8)

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
        clash = ob.Trajectory([0.0], [[1.0, 2.0]], names=("a", "a|observed"))
        with pytest.raises(ob.InputError, match=r"a channel is called 'a\|observed'"):
            to_pandas(clash, masks=True)
        with pytest.raises(ob.InputError, match="must be numbers"):
            from_pandas(frame.assign(hip="a"))


class TestLoader:
    @pytest.fixture
    def data(self):
        rows = (5, 3, 4, 6, 2)
        return ob.Dataset(
            tuple(
                ob.Trajectory(np.arange(n) / 4, np.full((n, 2), float(i)), names=("a", "b"))
                for i, n in enumerate(rows)
            )
        )

    def test_batches_are_those_of_the_trajectories_in_order(self, data):
        loader = ob.data_loader(data, batch_size=2)
        batches = list(loader)
        assert len(loader) == len(batches) == 3
        expected = ob.Batch.of(data[2:4])
        for name in ("times", "values", "mask", "known", "valid"):
            assert torch.equal(getattr(batches[1], name), getattr(expected, name))
        scaler = ob.Scaler.fit("standardise", data)
        (one,) = ob.data_loader(data, batch_size=5, scaler=scaler, dtype=torch.float64)
        assert torch.equal(one.values, ob.Batch.of(data, scaler=scaler, dtype=torch.float64).values)

    def test_a_shuffled_order_is_that_of_the_seed_and_new_in_each_epoch(self, data):
        def epochs(seed):
            loader = ob.data_loader(data, batch_size=1, shuffle=True, seed=seed)
            return [[int(batch.values[0, 0, 0]) for batch in loader] for _ in range(3)]

        assert epochs(0) == epochs(0)
        assert epochs(0) != epochs(1)
        assert all(sorted(order) == [0, 1, 2, 3, 4] for order in epochs(0))
        assert len({tuple(order) for order in epochs(0)}) > 1

    def test_numbers_out_of_range_are_refused(self, data):
        for options in ({"batch_size": 0}, {"workers": -1}, {"seed": -1}):
            with pytest.raises(ob.InputError, match="must be"):
                ob.data_loader(data, **options)
