"""Cleaning of recordings while they are read: closed forms, and properties."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from offbeat.data.cleaning import channels as cleaned
from offbeat.data.cleaning.log import sentences
from offbeat.data.recording import ReaderOptions, Recording, Signal, assemble
from offbeat.errors import FileFormatError, InputError

MS = 1_000_000
NAN = float("nan")


def signal(stamps_ms, *columns, name="", channels=None, **fields):
    values = np.array(columns, dtype=np.float64).T.reshape(len(stamps_ms), len(columns))
    names = channels or tuple("xyzwabcdef"[: len(columns)])
    stamps = np.array(stamps_ms, dtype=np.int64) * MS
    return Signal(name, stamps, values, names, **fields)


def built(*signals, **options):
    return assemble([Recording(signals)], ReaderOptions(**options))


def log_of(dataset):
    return dataset.meta["cleaning"]


def same(got, expected):
    return np.array_equal(got, np.array(expected, dtype=float), equal_nan=True)


class TestRoles:
    def test_options_give_channels_their_roles(self):
        logged = signal([0, 10], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0])
        dataset = built(logged, actions=["y"], exogenous=["z"])
        assert dataset.roles == ("state", "action", "exogenous")
        assert built(logged, actions=["y"], channels=["y", "x"]).roles == ("action", "state")
        with pytest.raises(InputError, match=r"unknown channel in actions 'u', expected one of: x"):
            built(logged, actions=["u"])

    def test_an_action_holds_until_the_next_one_also_between_its_own_stamps(self):
        state = signal([0, 10, 20, 30], [0.0, 1.0, 2.0, 3.0], name="arm")
        command = signal([5, 20], [7.0, 8.0], name="cmd", roles=("action",))
        dataset = built(state, command)
        assert dataset[0].times.tolist() == [0.0, 0.005, 0.01, 0.02, 0.03]
        assert dataset[0].actions[:, 0].tolist() == [7.0, 7.0, 7.0, 8.0, 8.0]
        resampled = built(state, command, resample_hz=200)[0]
        assert resampled.actions[:, 0].tolist() == [7.0, 7.0, 7.0, 7.0, 8.0, 8.0, 8.0]

    def test_the_values_of_an_action_stay_what_was_commanded(self):
        repeated = np.repeat(np.arange(20.0), 5)
        stamps = 10 * np.arange(100)
        logged = signal(stamps, repeated, repeated, roles=("state", "action"))
        dataset = built(logged, repeated="mask")
        assert dataset[0].observed.sum(axis=0).tolist() == [20, 100]
        flips = np.resize([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]], (8, 4))
        q = signal(10 * np.arange(8), *flips.T, channels=("qw", "qx", "qy", "qz"))
        assert same(built(q, actions=q.channels)[0].values, flips)


class TestOrder:
    def test_late_rows_are_sorted_in_and_counted(self):
        dataset = built(signal([0, 20, 10, 30], [0.0, 2.0, 1.0, 3.0]))
        assert dataset[0].times.tolist() == [0.0, 0.01, 0.02, 0.03]
        assert dataset[0].values[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
        assert log_of(dataset)["order"] == {"option": "sort", "late": 1, "signals": {"x": 1}}
        assert "1 row came late and was sorted" in sentences(log_of(dataset))

    def test_late_rows_can_be_dropped(self):
        dataset = built(signal([0, 20, 10, 30], [0.0, 2.0, 1.0, 3.0]), order="drop")
        assert dataset[0].values[:, 0].tolist() == [0.0, 2.0, 3.0]

    def test_late_rows_can_be_refused_and_the_error_says_where(self):
        with pytest.raises(
            FileFormatError, match=r"got 0.02 s at row 1 and 0.01 s at row 2; order=sort"
        ):
            built(signal([0, 20, 10, 30], [0.0, 2.0, 1.0, 3.0]), order="refuse")

    @given(st.permutations(range(8)))
    def test_any_order_of_rows_gives_the_same_data_set(self, order):
        order = np.array(order)
        shuffled = built(signal(10 * order, order), clock_jumps="join")
        assert shuffled.fingerprint() == built(signal(10 * np.arange(8), range(8))).fingerprint()


class TestDuplicates:
    STAMPS = (0, 10, 10, 20)
    COLUMNS = ((0.0, 1.0, 3.0, 4.0), (0.0, 7.0, NAN, 4.0))

    @pytest.mark.parametrize(
        ("option", "merged"), [("last", [3.0, 7.0]), ("first", [1.0, 7.0]), ("mean", [2.0, 7.0])]
    )
    def test_of_each_channel_the_known_values_are_merged(self, option, merged):
        dataset = built(signal(self.STAMPS, *self.COLUMNS), duplicates=option)
        assert dataset[0].times.tolist() == [0.0, 0.01, 0.02]
        assert dataset[0].values[1].tolist() == merged
        assert log_of(dataset)["duplicates"]["rows"] == 1

    def test_the_first_known_value_counts_where_the_first_row_has_none(self):
        dataset = built(signal([0, 0, 0, 10], [NAN, 5.0, 6.0, 1.0]), duplicates="first")
        assert dataset[0].values[:, 0].tolist() == [5.0, 1.0]

    @pytest.mark.parametrize("option", ["last", "first", "mean"])
    def test_what_no_row_knows_stays_unknown(self, option):
        dataset = built(signal([0, 10, 10, 20], [1.0, NAN, NAN, 2.0]), duplicates=option)
        assert same(dataset[0].values[:, 0], [1.0, NAN, 2.0])

    def test_they_can_be_refused(self):
        with pytest.raises(FileFormatError, match=r"0\.01 s at row 1 and 0\.01 s at row 2"):
            built(signal(self.STAMPS, *self.COLUMNS), duplicates="refuse")

    def test_that_meet_only_after_sorting_are_found(self):
        dataset = built(signal([0, 20, 10, 20], [0.0, 1.0, 2.0, 3.0]))
        assert dataset[0].values[:, 0].tolist() == [0.0, 2.0, 3.0]


class TestClockJumps:
    BACK = (*range(0, 1000, 10), *range(-60_000, -59_000, 10))

    def test_a_clock_set_back_begins_a_new_episode(self):
        first, second = dataset = built(signal(self.BACK, range(200)))
        assert (first.rows, second.rows) == (100, 100)
        assert second.values[0, 0] == 100
        assert log_of(dataset)["clock_jumps"] == {"option": "split", "found": 1}
        assert log_of(dataset)["order"]["late"] == 0
        assert log_of(dataset)["episodes"] == [{"episode": 1, "clock_set_before": 1}]

    def test_a_clock_set_forth_by_more_than_a_day_begins_a_new_episode(self):
        stamps = [*range(0, 1000, 10), *range(1_700_000_000_000, 1_700_000_001_000, 10)]
        dataset = built(signal(stamps, range(200)), max_gap_s=None)
        assert [t.rows for t in dataset] == [100, 100]
        assert log_of(dataset)["clock_jumps"]["found"] == 1

    def test_it_can_be_ignored_or_refused(self):
        joined = built(signal(self.BACK, range(200)), clock_jumps="join", max_gap_s=None)
        assert joined[0].rows == 200
        assert log_of(joined)["order"]["late"] == 100
        with pytest.raises(FileFormatError, match=r"set from 0.99 to -60 s at row 100"):
            built(signal(self.BACK, range(200)), clock_jumps="refuse")

    def test_a_single_late_row_is_none_however_late(self):
        stamps = list(range(0, 100_000, 10))
        stamps[5000] = 3
        dataset = built(signal(stamps, range(10_000)))
        assert log_of(dataset)["clock_jumps"]["found"] == 0
        assert log_of(dataset)["order"]["late"] == 1

    def test_rows_without_any_order_are_none(self):
        stamps = np.random.default_rng(0).permutation(5000) * 1000
        dataset = built(signal(stamps, range(5000)))
        assert log_of(dataset)["clock_jumps"]["found"] == 0
        assert len(dataset) == 1

    def test_all_signals_are_cut_where_the_clock_was_set(self):
        slow = signal(self.BACK[::10], range(20), name="slow")
        pausing = signal([500], [1.0], name="pausing", channels=("z",))
        dataset = built(signal(self.BACK, range(200), name="fast"), slow, pausing)
        assert dataset.names == ("fast.x", "slow.x", "pausing.z")
        known = [t.known.sum(axis=0).tolist() for t in dataset]
        assert known == [[100, 10, 1], [100, 10, 0]]


class TestOutages:
    STAMPS = (*range(0, 1000, 10), *range(13_000, 14_000, 10))

    def test_split_into_episodes_that_each_begin_at_0(self):
        first, second = dataset = built(signal(self.STAMPS, range(200)))
        assert [first.times[0], second.times[0]] == [0.0, 0.0]
        assert dataset.meta["clock_start"] == [0, 13_000 * MS]
        found = log_of(dataset)["outages"]
        assert (found["found"], found["longest_s"]) == (1, 12.01)
        assert "1 outage of 12 s" in " ".join(sentences(log_of(dataset)))

    def test_by_default_more_than_20_usual_steps_and_a_second(self):
        steps = np.full(200, 100)
        steps[100] = 2000
        assert len(built(signal(np.cumsum(steps), range(200)))) == 1
        steps[100] = 2001
        assert len(built(signal(np.cumsum(steps), range(200)))) == 2

    def test_by_default_never_in_a_log_of_few_rows(self):
        assert len(built(signal([0, 10, 20, 60_000], range(4)))) == 1

    @pytest.mark.parametrize(("limit", "episodes"), [(None, 1), (12.01, 1), (12.009, 2), (5, 2)])
    def test_a_limit_can_be_given(self, limit, episodes):
        assert len(built(signal(self.STAMPS, range(200)), max_gap_s=limit)) == episodes

    def test_a_pause_of_one_sensor_is_no_outage_while_others_report(self):
        fast = signal(range(0, 60_000, 10), range(6000), name="fast")
        slow = signal([0, 59_000], [1.0, 2.0], name="slow")
        assert len(built(fast, slow)) == 1

    def test_what_is_left_with_a_single_row_is_left_out_and_counted(self):
        stamps = [*range(0, 1000, 10), 50_000, *range(100_000, 101_000, 10)]
        dataset = built(signal(stamps, range(201)))
        assert [t.rows for t in dataset] == [100, 100]
        assert log_of(dataset)["left_out"] == {
            "min_rows": 2,
            "episodes": 1,
            "rows": 1,
            "without_rows": 0,
        }
        assert len(built(signal(stamps, range(201)), min_rows=1)) == 3

    def test_parts_are_labelled_after_their_episode(self):
        one = Recording((signal(self.STAMPS, range(200)),), label="b", origin="walk.csv")
        two = Recording((signal([0, 10], [1.0, 2.0]),), label="a")
        dataset = assemble([one, two])
        assert dataset.meta["labels"] == ["b/1", "b/2", "a"]
        assert dataset[1].origin == "walk.csv, part 2"


class TestTheUnion:
    def test_signals_of_different_rates_meet_on_the_union_of_their_stamps(self):
        fast = signal([0, 10, 20, 30], [0.0, 1.0, 2.0, 3.0], name="imu")
        slow = signal([5, 20], [7.0, 8.0], name="gps", units=("m",))
        dataset = built(fast, slow)
        assert dataset.names == ("imu.x", "gps.x")
        assert dataset.units == ("", "m")
        assert dataset[0].times.tolist() == [0.0, 0.005, 0.01, 0.02, 0.03]
        assert same(dataset[0].values, [[0, NAN], [NAN, 7], [1, NAN], [2, 8], [3, NAN]])

    @given(
        st.lists(st.integers(0, 60), min_size=1, max_size=20, unique=True),
        st.lists(st.integers(0, 60), min_size=1, max_size=20, unique=True),
    )
    def test_no_value_is_lost_and_none_is_made_up(self, one, two):
        one, two = np.sort(one), np.sort(two)
        dataset = built(signal(one, one, name="a"), signal(two, two, name="b"), max_gap_s=None)
        start = min(one[0], two[0])
        for channel, stamps in enumerate((one, two)):
            column = dataset[0].values[:, channel]
            known = ~np.isnan(column)
            assert column[known].tolist() == stamps.tolist()
            expected = [(int(t) - int(start)) / 1000 for t in stamps]
            assert dataset[0].times[known].tolist() == expected

    def test_episodes_need_not_have_the_same_signals(self):
        dataset = assemble(
            [
                Recording((signal([0, 10], [1.0, 2.0], name="a"),)),
                Recording((signal([0, 10], [3.0, 4.0], name="b"),)),
            ]
        )
        assert dataset.names == ("a.x", "b.x")
        assert same(dataset[1].values, [[NAN, 3], [NAN, 4]])

    def test_a_recording_without_a_row_is_left_out(self):
        dataset = assemble([Recording((signal([], []),)), Recording((signal([0], [1.0]),))])
        assert len(dataset) == 1
        assert log_of(dataset)["left_out"]["without_rows"] == 1
        with pytest.raises(FileFormatError, match="there is no row to read"):
            assemble([Recording((signal([], []),))])
        with pytest.raises(FileFormatError, match="no recordings"):
            assemble([])

    def test_names_and_units_must_agree(self):
        with pytest.raises(FileFormatError, match=r"have the name 'a\.x'"):
            built(signal([0], [1.0]), signal([0], [1.0], [2.0], name="a", channels=("y", "x")),
                  signal([0], [1.0], name="", channels=("a.x",)))  # fmt: skip
        with pytest.raises(FileFormatError, match="is in 'm' here and in 'cm' there"):
            assemble([Recording((signal([0], [1.0], units=(u,)),)) for u in ("m", "cm")])


class TestChannels:
    def test_are_chosen_by_name_in_the_order_asked_for(self):
        fast = signal([0, 10, 20], [0.0, 1.0, 2.0], [3.0, 4.0, 5.0], name="imu")
        slow = signal([5], [7.0], name="gps")
        dataset = built(fast, slow, channels=("gps.x", "imu.y"))
        assert dataset.names == ("gps.x", "imu.y")
        assert same(dataset[0].values, [[NAN, 3], [7, NAN], [NAN, 4], [NAN, 5]])

    def test_rows_of_signals_that_are_left_out_are_not_read(self):
        fast = signal([0, 10, 20], [0.0, 1.0, 2.0], name="imu")
        dataset = built(fast, signal([5, 15], [7.0, 8.0], name="gps"), without=("imu.x",))
        assert dataset[0].rows == 2
        assert dataset.names == ("gps.x",)

    def test_that_are_not_there_are_an_error(self):
        with pytest.raises(InputError, match="unknown channel 'q'"):
            built(signal([0], [1.0]), channels=("q",))
        with pytest.raises(InputError, match="no channels but those to be left out"):
            built(signal([0], [1.0]), without=("x",))


class TestRepeatedValues:
    STAMPS = range(0, 1000, 5)

    def repeated(self, **options):
        fresh = np.random.default_rng(0).normal(size=50)
        moving = np.random.default_rng(1).normal(size=200)
        columns = (np.repeat(fresh, 4), moving, np.ones(200))
        return fresh, built(signal(self.STAMPS, *columns), **options)

    def test_a_slower_sensor_on_a_faster_grid_is_found(self):
        _, dataset = self.repeated()
        found = log_of(dataset)["repeated"]
        assert found["channels"] == {"x": {"fraction": 150 / 199, "rows_per_value": 4}}
        assert found["masked"] == 0
        assert dataset[0].known.all()

    def test_repeats_are_masked_on_request(self):
        fresh, dataset = self.repeated(repeated="mask")
        column = dataset[0].values[:, 0]
        assert np.flatnonzero(~np.isnan(column)).tolist() == list(range(0, 200, 4))
        assert column[::4].tolist() == fresh.tolist()
        assert dataset[0].known[:, 1:].all()
        assert log_of(dataset)["repeated"]["masked"] == 150

    def test_a_sensor_at_rest_is_measured_at_its_own_rate(self):
        values = np.repeat(np.arange(30.0), 4)
        values[40:80] = 10.0  # rests for ten of its own steps
        dataset = built(signal(range(0, 600, 5), values), repeated="mask")
        assert np.flatnonzero(dataset[0].known[:, 0]).tolist() == list(range(0, 120, 4))

    def test_a_sensor_that_now_and_then_rests_repeats_nothing(self):
        values = np.random.default_rng(0).normal(size=200)
        values[50:190] = 1.0
        assert log_of(built(signal(self.STAMPS, values)))["repeated"]["channels"] == {}

    def test_repeats_are_found_over_all_episodes_together(self):
        parts = [
            Recording((signal(range(0, 60, 5), np.repeat(np.arange(3.0) + 10 * i, 4)),))
            for i in range(6)
        ]
        dataset = assemble(parts, ReaderOptions(repeated="mask"))
        assert log_of(dataset)["repeated"]["channels"]["x"]["rows_per_value"] == 4
        assert all(t.known.sum() == 3 for t in dataset)

    @given(
        st.lists(
            st.lists(st.sampled_from([0.0, 1.0, 2.0, NAN, float("inf")]), max_size=60), max_size=3
        ),
        st.integers(1, 3),
    )
    def test_repeats_are_what_the_definition_says_however_early_it_is_decided(
        self, episodes, repeat
    ):
        columns = [np.repeat(np.array(column, dtype=float), repeat) for column in episodes]
        known = [[x for x in column.tolist() if not np.isnan(x)] for column in columns]
        pairs = [a == b for column in known for a, b in itertools.pairwise(column)]
        runs = [
            len(list(run))
            for column in known
            for run in [list(g) for _, g in itertools.groupby(column)][:-1]
        ]
        usual = int(np.median(runs)) if runs else 0
        expected = None
        if pairs and sum(pairs) >= 0.5 * len(pairs) and len(runs) >= 10 and usual >= 2:
            expected = cleaned.Repeats(sum(pairs) / len(pairs), usual)
        assert cleaned.find_repeats(columns) == expected


class TestAngles:
    def test_turns_are_taken_out(self):
        angles = np.linspace(0, 20, 200)
        wrapped = np.angle(np.exp(1j * angles))
        dataset = built(signal(range(200), wrapped, kinds=("angle",)))
        assert np.allclose(dataset[0].values[:, 0], angles, atol=1e-12)
        assert log_of(dataset)["angles"]["turns"] == {"x": 3}

    def test_degrees_turn_at_360_and_missing_values_are_skipped(self):
        dataset = built(
            signal([0, 10, 20, 30], [350.0, NAN, 10.0, 20.0], units=("deg",)), angles=("x",)
        )
        assert same(dataset[0].values[:, 0], [350, NAN, 370, 380])

    def test_they_can_be_left_as_they_are(self):
        dataset = built(signal([0, 10], [3.0, -3.0], kinds=("angle",)), unwrap=False)
        assert dataset[0].values[:, 0].tolist() == [3.0, -3.0]

    def test_the_array_of_the_reader_becomes_that_of_the_trajectory_where_nothing_is_cleaned(self):
        logged = signal([0, 10], [1.0, 2.0], [3.0, 4.0])
        (one,) = built(logged)
        assert np.shares_memory(one.values, logged.values)
        with pytest.raises(ValueError, match="read-only"):
            logged.values[0, 0] = np.inf

    def test_the_array_of_the_reader_is_not_written_to(self):
        logged = signal([0, 10], [3.0, -3.0], kinds=("angle",))
        before = logged.values.copy()
        built(logged)
        assert np.array_equal(logged.values, before)

    def test_one_that_is_not_there_is_an_error(self):
        with pytest.raises(InputError, match="unknown channel in angles 'yaw'"):
            built(signal([0], [1.0]), angles=("yaw",))


class TestQuaternions:
    KIND = {"kinds": ("quaternion",) * 4}  # noqa: RUF012

    def turning(self, n=100):
        """About the z axis, twice round: the scalar changes sign."""
        half = np.linspace(0, 2 * np.pi, n)
        return np.column_stack([0 * half, 0 * half, np.sin(half), np.cos(half)])

    def test_signs_are_continuous(self):
        rotation = self.turning()
        flipped = rotation * np.where(np.arange(100) % 7 < 3, -1, 1)[:, None]
        dataset = built(signal(range(100), *flipped.T, **self.KIND))
        assert np.allclose(dataset[0].values, -rotation, atol=1e-15)
        assert log_of(dataset)["quaternions"]["flipped"] == int((np.arange(100) % 7 >= 3).sum())

    def test_lengths_are_1_and_one_of_length_0_is_missing(self):
        rotation = self.turning(5) * np.array([2.0, 1.0, 0.0, 1.0, 1.0])[:, None]
        dataset = built(signal(range(5), *rotation.T, **self.KIND))
        values = dataset[0].values
        assert np.isnan(values[2]).all()
        assert np.allclose(np.linalg.norm(values[[0, 1, 3, 4]], axis=1), 1, atol=1e-15)
        found = log_of(dataset)["quaternions"]
        assert (found["renormalised"], found["dropped"]) == (1, 1)

    @pytest.mark.parametrize(
        "names", ["qx qy qz qw", "q_w q_x q_y q_z", "p.orientation.x p.orientation.y "
                  "p.orientation.z p.orientation.w", "q_RS_w q_RS_x q_RS_y q_RS_z"]
    )  # fmt: skip
    def test_they_are_found_by_names_and_length(self, names):
        rotation = -self.turning()
        channels = tuple(names.split())
        dataset = built(signal(range(100), *rotation.T, channels=channels))
        assert log_of(dataset)["quaternions"]["channels"] == [list(channels)]

    @pytest.mark.parametrize(
        ("names", "scale"),
        [("qx qy qz qw", 3.0), ("accel_x accel_y accel_z accel_w", 1.0), ("qx qy qw qz", 1.0)],
    )
    def test_others_are_not_taken_for_one(self, names, scale):
        rotation = scale * self.turning()
        dataset = built(signal(range(100), *rotation.T, channels=tuple(names.split())))
        assert log_of(dataset)["quaternions"]["channels"] == []
        assert dataset[0].values.tobytes("C") == rotation.tobytes()

    def test_they_can_be_kept_as_they_are(self):
        rotation = 2 * self.turning()
        dataset = built(signal(range(100), *rotation.T, **self.KIND), quaternions="keep")
        assert dataset[0].values.tobytes("C") == rotation.tobytes()


class TestInfiniteValues:
    def test_count_as_missing_or_are_refused(self):
        logged = signal([0, 10], [np.inf, 1.0])
        dataset = built(logged)
        assert same(dataset[0].values[:, 0], [NAN, 1])
        assert log_of(dataset)["infinite"]["values"] == 1
        assert np.isinf(logged.values[0, 0])
        with pytest.raises(FileFormatError, match="infinite at row 0, channel 'x'"):
            built(logged, infinite="refuse")


class TestResampling:
    def test_each_row_holds_what_was_measured_last_since_the_row_before(self):
        logged = signal([0, 4, 9, 10, 31], [1.0, 2.0, 3.0, 4.0, 5.0])
        dataset = built(logged, resample_hz=100)
        assert dataset[0].times.tolist() == [0.0, 0.01, 0.02, 0.03, 0.04]
        assert same(dataset[0].values[:, 0], [1, 4, NAN, NAN, 5])

    def test_a_grid_that_fits_changes_nothing(self):
        logged = signal(range(0, 1000, 10), range(100))
        assert built(logged, resample_hz=100).fingerprint() == built(logged).fingerprint()

    @given(st.lists(st.integers(0, 3000), min_size=1, max_size=30, unique=True))
    def test_no_row_knows_the_future(self, stamps):
        stamps = np.sort(stamps)
        dataset = built(signal(stamps, stamps - stamps[0]), resample_hz=50, max_gap_s=None)
        column, times = dataset[0].values[:, 0], dataset[0].times
        known = ~np.isnan(column)
        assert (column[known] / 1000 <= times[known] + 1e-9).all()
        assert (column[known] / 1000 > times[known] - 0.02 - 1e-9).all()
        assert np.diff(times) == pytest.approx(0.02, abs=1e-9)


class TestClocks:
    def test_nanoseconds_since_1970_lose_nothing(self):
        start = 1_700_000_000_123_456_789
        logged = Signal("", np.array([start, start + 1, start + 3]), np.zeros((3, 1)), ("x",))
        dataset = assemble([Recording((logged,))])
        assert dataset[0].times.tolist() == [0.0, 1e-9, 3e-9]
        assert dataset.meta["clock_start"] == [start]

    def test_the_start_is_told_in_the_unit_of_the_file(self):
        logged = signal([1500, 1510], [0.0, 1.0])
        for unit, start in (("s", 1.5), ("ms", 1500), ("us", 1_500_000), ("100ns", 15_000_000)):
            meta = assemble([Recording((logged,), time_unit=unit)]).meta
            assert (meta["clock_start"], meta["time_unit"]) == ([start], unit)

    def test_times_can_be_those_of_the_recordings_own_clock(self):
        dataset = built(signal([1500, 1510], [0.0, 1.0]), start="clock")
        assert dataset[0].times.tolist() == [1.5, 1.51]
        assert "clock_start" not in dataset.meta


def test_the_log_is_json_with_every_option_and_each_note_once():
    parts = [Recording((signal([0], [1.0]),), notes=("said",)) for _ in range(3)]
    found = log_of(assemble(parts))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["notes"] == ["said"]
    assert sentences(found) == ["said"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": "sorted"}, "unknown order 'sorted', expected one of: drop, refuse, sort"),
        ({"repeated": "hide"}, "unknown repeated 'hide'"),
        ({"max_gap_s": 0}, "max_gap_s must be seconds above 0, 'auto', or None"),
        ({"max_gap_s": "never"}, "got 'never'"),
        ({"resample_hz": -1}, "resample_hz must be above 0"),
        ({"resample_hz": float("nan")}, "resample_hz must be above 0"),
        ({"angles": "yaw"}, "angles must be names of channels, got 'yaw'"),
        ({"channels": ()}, "at least one channel"),
        ({"unwrap": "yes"}, "unwrap must be True or False"),
        ({"min_rows": 0}, "min_rows must be at least 1"),
        ({"min_rows": 1.5}, "min_rows must be an integer"),
    ],
)
def test_options_that_are_none_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        ReaderOptions(**options)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stamps": np.zeros(2)}, "stamps must be int64 nanoseconds"),
        ({"values": np.zeros((3, 1))}, r"float64 of shape \(2, 1\)"),
        ({"units": ("m", "m")}, "got 2 units, 1 kinds and 1 roles for 1 channels"),
        ({"kinds": ("turn",)}, "unknown kind of channel 'turn'"),
        ({"kinds": ("quaternion",)}, "four in a row make one"),
    ],
)
def test_a_signal_is_checked_when_it_is_made(fields, message):
    good = {"name": "", "stamps": np.zeros(2, np.int64), "values": np.zeros((2, 1))}
    with pytest.raises(InputError, match=message):
        Signal(**(good | {"channels": ("x",)} | fields))
