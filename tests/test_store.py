"""Data sets on disk: exact round trips, whole files, and clear errors for all others."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from offbeat.data import store
from offbeat.data.schema import METADATA_KEY, SCHEMA_VERSION
from offbeat.data.store import holds_data_set, load, save
from offbeat.data.trajectory import ROLES, Dataset, Trajectory
from offbeat.errors import FileFormatError, InputError

FLOATS = st.floats(allow_nan=True, allow_infinity=False)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip


@st.composite
def datasets(draw):
    channels = draw(st.integers(1, 3))
    text = st.text(max_size=5)
    free = text.filter(lambda name: name != "time" and "|" not in name)
    names = draw(st.lists(free, min_size=channels, max_size=channels, unique=True))
    units = draw(st.lists(text, min_size=channels, max_size=channels))
    roles = draw(st.lists(st.sampled_from(ROLES), min_size=channels, max_size=channels))
    trajectories = []
    for _ in range(draw(st.integers(1, 4))):
        times = draw(st.lists(FLOATS.filter(lambda x: x == x), min_size=1, max_size=5, unique=True))
        shape = (len(times), channels)
        values = draw(hnp.arrays(np.float64, shape, elements=FLOATS))
        seen = draw(hnp.arrays(np.bool_, shape))
        trajectories.append(
            Trajectory(
                np.sort(times),
                values,
                observed=seen & ~np.isnan(values) if draw(st.booleans()) else None,
                names=names,
                units=units,
                roles=roles,
                origin=draw(text),
            )
        )
    return Dataset(trajectories, draw(st.dictionaries(st.text(), JSON, max_size=3)))


def assert_identical(got: Dataset, expected: Dataset) -> None:
    assert got.meta == expected.meta
    assert len(got) == len(expected)
    for a, b in zip(got, expected, strict=True):
        assert (a.names, a.units, a.roles, a.origin) == (b.names, b.units, b.roles, b.origin)
        assert a.times.tobytes() == b.times.tobytes()
        assert a.values.tobytes() == b.values.tobytes()
        assert a.observed.tobytes() == b.observed.tobytes()


def example() -> Dataset:
    """Two trajectories of unlike length, a channel never known, a masked value, an action."""
    random = np.random.default_rng(0)
    trajectories = []
    for i, rows in enumerate((5, 3)):
        values = random.normal(size=(rows, 3))
        values[:, 2] = np.nan
        observed = ~np.isnan(values)
        observed[1, 0] = False
        trajectories.append(
            Trajectory(
                np.cumsum(random.random(rows)),
                values,
                observed=observed,
                names=("hip", "knee", "foot"),
                units=("rad", "rad", "N"),
                roles=("state", "action", "exogenous"),
                origin=f"walk {i}",
            )
        )
    return Dataset(trajectories, {"seed": 3, "versions": {"offbeat": "0"}, "nested": [1, None]})


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "walk.parquet"
    save(example(), path)
    return path


def rewritten(path, change_table=lambda table: table, change_schema=lambda schema: schema):
    """The file as another program might write it again."""
    table = pq.read_table(path)
    schema = change_schema(json.loads(table.schema.metadata[METADATA_KEY]))
    table = change_table(table)
    pq.write_table(table.replace_schema_metadata({METADATA_KEY: json.dumps(schema)}), path)
    return path


def test_importing_it_does_not_import_pyarrow():
    code = "import sys, offbeat.data.store; sys.exit('pyarrow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@given(dataset=datasets())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_loaded_is_what_was_saved_to_the_bit(dataset, tmp_path):
    save(dataset, tmp_path / "data.parquet")
    assert_identical(load(tmp_path / "data.parquet"), dataset)


def test_many_row_groups_give_the_same_data_set(monkeypatch, tmp_path):
    monkeypatch.setattr(store, "_ROWS_PER_GROUP", 4)
    save(example(), tmp_path / "walk.parquet")
    assert pq.ParquetFile(tmp_path / "walk.parquet").num_row_groups == 2
    assert_identical(load(tmp_path / "walk.parquet"), example())


def test_the_columns_can_be_read_by_any_parquet_library(path):
    table = pq.read_table(path)
    assert table.column_names == [*("trajectory", "time", "hip", "knee", "foot", "hip|observed")]
    assert table.column("trajectory").to_pylist() == [0] * 5 + [1] * 3
    assert table.column("hip|observed").to_pylist()[:3] == [True, False, True]


def test_a_channel_whose_known_values_are_all_observed_needs_no_column_for_it(tmp_path):
    known = Dataset([replace(t, observed=t.known) for t in example()])
    save(known, tmp_path / "known.parquet")
    assert "|observed" not in "".join(pq.read_schema(tmp_path / "known.parquet").names)
    assert_identical(load(tmp_path / "known.parquet"), known)


def test_an_empty_value_of_another_program_is_not_known(path):
    def without_foot(table):
        empty = pa.nulls(len(table), pa.float64())
        return table.set_column(table.column_names.index("foot"), "foot", empty)

    assert_identical(load(rewritten(path, without_foot)), example())


def test_the_loaded_arrays_are_read_only_views_of_one(path):
    first, second = load(path)
    assert np.shares_memory(first.values.base, second.values.base)
    assert not first.values.flags.writeable


def test_saving_over_a_file_replaces_it_and_leaves_nothing_else(path):
    save(example()[:1], path)
    assert len(load(path)) == 1
    assert [file.name for file in path.parent.iterdir()] == ["walk.parquet"]


def test_a_refused_save_leaves_the_file_that_stood_there(path):
    before = path.read_bytes()
    with pytest.raises(InputError, match="JSON-like"):
        save(Dataset(example().trajectories, {"seed": np.int64(3)}), path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["walk.parquet"]


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"a": {1, 2}}, "must be JSON-like"),
        ({"a": float("nan")}, "must be JSON-like"),
        ({"a": (1, 2)}, "cannot be restored"),
        ({"a": {1: 2}}, "cannot be restored"),
    ],
)
def test_meta_that_json_would_change_is_refused(meta, message, tmp_path):
    with pytest.raises(InputError, match=message):
        save(Dataset(example().trajectories, meta), tmp_path / "walk.parquet")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["time", "trajectory", "knee|observed"])
def test_a_channel_named_as_another_column_is_refused(name, tmp_path):
    def renamed(t):
        return replace(t, names=(name, "knee", "foot"), observed=np.zeros_like(t.observed))

    with pytest.raises(InputError, match="a channel is called"):
        save(Dataset([renamed(t) for t in example()]), tmp_path / "walk.parquet")


def test_a_data_set_of_offbeat_0_1_0_is_loaded_with_its_actions_as_channels(tmp_path):
    schema = {
        "version": 1, "rows": 3, "trajectories": 2, "names": ["hip", "knee"], "units": ["rad", ""],
        "observed": ["knee"], "actions": 2, "origins": ["a", "b"],
        "meta": {"seed": 1, "actions": ["left", "right"]},
    }  # fmt: skip
    table = pa.table(
        {
            "trajectory": pa.array([0, 0, 1], pa.int32()),
            "time": [0.0, 0.1, 0.0],
            "hip": [1.0, 2.0, 3.0],
            "knee": [4.0, 5.0, 6.0],
            "knee|observed": [True, False, True],
            "action|0": [0.1, 0.2, 0.3],
            "action|1": [0.4, 0.5, 0.6],
        }
    )
    path = tmp_path / "old.parquet"
    pq.write_table(table.replace_schema_metadata({"offbeat": json.dumps(schema)}), path)
    dataset = load(path)
    assert dataset.names == ("hip", "knee", "left", "right")
    assert dataset.roles == ("state", "state", "action", "action")
    assert dataset.units == ("rad", "", "", "")
    assert dataset[0].actions.tolist() == [[0.1, 0.4], [0.2, 0.5]]
    assert dataset[0].observed[:, 1].tolist() == [True, False]
    assert dataset.meta == {"seed": 1}
    # What 0.1.0 gave for the same data, by its definition.
    digest = hashlib.sha256(b"hip\0knee")
    for t in dataset:
        for array in (t.times, t.values[:, :2].copy(), t.observed[:, :2].copy()):
            digest.update(array.tobytes())
    assert dataset.fingerprint(version=1) == digest.hexdigest()


class TestAFileThatIsNoDataSet:
    def refused(self, path, message):
        with pytest.raises(FileFormatError, match=message) as caught:
            load(path)
        assert "\n" not in str(caught.value)
        assert path.name in str(caught.value)

    def test_is_refused_when_missing(self, tmp_path):
        self.refused(tmp_path / "walk.parquet", "No such file")

    def test_is_refused_when_it_is_a_folder(self, tmp_path):
        self.refused(tmp_path, "is a folder")

    def test_is_refused_when_empty(self, tmp_path):
        (tmp_path / "walk.parquet").touch()
        self.refused(tmp_path / "walk.parquet", "is empty")

    def test_is_refused_when_it_is_a_git_lfs_pointer(self, tmp_path):
        pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n"
        (tmp_path / "walk.parquet").write_text(pointer)
        self.refused(tmp_path / "walk.parquet", "git lfs pull")

    @pytest.mark.parametrize("share", [0.001, 0.3, 0.9, 0.999])
    def test_is_refused_when_truncated(self, path, share):
        content = path.read_bytes()
        path.write_bytes(content[: max(1, int(share * len(content)))])
        self.refused(path, "truncated, damaged or of another format")

    def test_is_refused_when_it_is_no_parquet(self, path):
        path.write_text("time,hip\n0,1\n")
        self.refused(path, "can't be read as Parquet")

    def test_is_refused_when_it_is_parquet_of_another_program(self, path):
        pq.write_table(pa.table({"time": [0.0, 1.0]}), path)
        self.refused(path, "no data set of Offbeat")
        assert not holds_data_set(path)

    def test_is_refused_when_its_schema_is_newer(self, path):
        newer = SCHEMA_VERSION + 1
        rewritten(path, change_schema=lambda old: {"version": newer, "other": 1})
        self.refused(path, f"version {newer} of the schema, this Offbeat reads up to")

    @pytest.mark.parametrize(
        "change",
        [
            lambda schema: [],
            lambda schema: {"version": 1},
            lambda schema: schema | {"version": "one"},
            lambda schema: schema | {"surprise": 1},
        ],
    )
    def test_is_refused_when_its_schema_is_damaged(self, path, change):
        self.refused(rewritten(path, change_schema=change), "damaged schema")

    @pytest.mark.parametrize(
        "change",
        [
            {"rows": 9},
            {"trajectories": 3},
            {"origins": ["walk 0"]},
        ],
    )
    def test_is_refused_when_its_counts_do_not_match(self, path, change):
        self.refused(
            rewritten(path, change_schema=lambda schema: schema | change), "its schema says"
        )

    def test_is_refused_when_rows_were_dropped(self, path):
        self.refused(
            rewritten(path, lambda table: table.slice(1)), "holds 7 rows of 2 trajectories"
        )

    def test_is_refused_when_rows_were_shuffled(self, path):
        self.refused(
            rewritten(path, lambda table: table.take([7, 6, 5, 4, 3, 2, 1, 0])), "one after"
        )

    def test_is_refused_when_a_column_is_gone(self, path):
        self.refused(
            rewritten(path, lambda table: table.drop_columns(["knee"])), r"missing knee \(double\)"
        )

    def test_is_refused_when_a_column_has_another_type(self, path):
        def shorter(table):
            return table.set_column(1, "time", table.column("time").cast(pa.float32()))

        self.refused(rewritten(path, shorter), r"unexpected time \(float\)")

    def test_is_refused_when_a_row_belongs_to_no_trajectory(self, path):
        def nameless(table):
            return table.set_column(0, "trajectory", pa.nulls(len(table), pa.int32()))

        self.refused(rewritten(path, nameless), "empty values in column 'trajectory'")

    def test_is_refused_when_its_times_do_not_increase(self, path):
        def stopped(table):
            return table.set_column(1, "time", pa.array(np.zeros(len(table))))

        self.refused(rewritten(path, stopped), r"invalid trajectory.*walk 0.*increase strictly")


def test_a_flipped_bit_anywhere_is_noticed_or_changes_nothing(path):
    content = path.read_bytes()
    noticed = 0
    for position in range(0, len(content), 3):
        damaged = bytearray(content)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        try:
            dataset = load(path)
        except FileFormatError:
            noticed += 1
        else:
            assert_identical(dataset, example())
    assert noticed > len(content) / 6


def test_a_tensor_file_whose_header_is_as_long_as_a_pickle_starts_is_not_taken_for_one(tmp_path):
    from safetensors.numpy import save as dump

    from offbeat.data.source import require_file

    path = tmp_path / "model.safetensors"
    every = (dump({"a": np.zeros(1)}, {"note": "x" * n}) for n in range(1000))
    data = next(data for data in every if data[:2] == bytes([0x80, 2]))
    path.write_bytes(data)
    assert require_file(path) == path
