"""What is chosen for logs as people have them, each of a kind that has gone wrong somewhere."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from odd_logs import ODD_LOGS, at, log, motion, out, write_csv

import offbeat as ob
from offbeat.cli.app import main
from offbeat.config import SplitConfig
from offbeat.data.plan import find_sensors, plan, prepare
from offbeat.data.redundant import Redundant
from offbeat.data.representative import unlikeness
from offbeat.data.splits import split_in_blocks
from offbeat.data.tasks import draw_tasks


@pytest.fixture(scope="module", params=ODD_LOGS)
def odd(request):
    dataset = ODD_LOGS[request.param]()
    return request.param, dataset, plan(dataset)


def test_the_horizon_and_the_windows_fit_the_log(odd):
    name, dataset, chosen = odd
    assert chosen.typical_gap_s <= chosen.horizon_s <= max(1.0, 10 * chosen.typical_gap_s)
    assert chosen.horizons_s[-1] == pytest.approx(chosen.horizon_s, rel=0.01)
    longest = max(chosen.horizon_s, chosen.longest_silence_s)
    assert chosen.window_s >= 0.99 * 3 * longest or name == "long_dropouts"
    lasts = sum(float(t.times[-1] - t.times[0]) for t in dataset)
    assert chosen.window_s <= 0.35 * lasts
    said = " ".join(chosen.notes)
    assert f"forecasts up to {chosen.horizon_s:g} s" in said
    assert ("less than three times the longest silence" in said) == (name == "long_dropouts")


def test_the_split_has_windows_in_every_part_and_none_spans_two(odd):
    name, dataset, chosen = odd
    data = prepare(dataset, chosen)
    parts = ob.apply_split(data, chosen.split)
    for part in parts:
        assert any(t.rows >= 2 for t in part)
        states = [c for c, role in enumerate(part.roles) if role == "state"]
        assert all(any(t.known[:, c].any() for t in part) for c in states) or part is not parts[0]
        hidden = sum(int((t.known & ~t.observed)[:, states].sum()) for t in part)
        assert hidden > 0, "there is something to fill, and to be scored"
    if chosen.split.by == "blocks":
        pieces = split_in_blocks(
            data, blocks=chosen.split.blocks, gap_s=chosen.split.gap_s, seed=chosen.split.seed
        )
        assert (chosen.split.blocks > 1) == (name != "short"), "several places, if there is room"
        for part in pieces[1:]:
            assert len(part) >= chosen.split.blocks


def test_tasks_can_be_drawn_from_the_parts(odd):
    _, dataset, chosen = odd
    for part in ob.apply_split(prepare(dataset, chosen), chosen.whole):
        tasks = draw_tasks(part, chosen.tasks, 40)
        states = [c for c, role in enumerate(tasks.roles) if role == "state"]
        kept = [t.observed[:, states].sum() for t in tasks]
        assert sum(kept) > 0
        longest = max(float(t.times[-1] - t.times[0]) for t in tasks)
        assert longest <= chosen.window_s + 1e-9
        assert {kind for kind, _, _ in tasks.meta["tasks"]} == {"logged", "silence", "cut"}


def test_the_same_is_chosen_from_a_file_and_the_command_says_nothing_more(odd, tmp_path, capsys):
    name, _, chosen = odd
    path = write_csv(ODD_LOGS[name](), tmp_path / "log.csv")
    read = ob.read(path)
    again = plan(read)
    for field in ("reader", "sensors", "horizon_s", "window_s", "split", "notes"):
        if name != "many_episodes":  # whose lengths are rounded
            assert getattr(again, field) == getattr(chosen, field), field
    assert again.redundant.names == chosen.redundant.names
    capsys.readouterr()
    assert main(["inspect", str(path), "--run", "run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["advice"]["command"] == ["offbeat", "train", str(path), "run"]
    assert told["advice"]["reasons"] == list(again.notes)


def test_a_model_can_be_made_for_it_and_answers_in_every_channel(odd):
    _, dataset, chosen = odd
    data = prepare(dataset, chosen)
    train, _, test = ob.apply_split(data, chosen.split)
    model = ob.make_model("gru", train, scaler="robust", hidden_size=3)
    spread = np.array(model.statistics.std)
    states = np.array([role == "state" for role in model.roles])
    assert spread[states] == pytest.approx(1.0, rel=1e-3), "no scale is that of a wild value"
    answers = ob.predict(model, dataset[:1].select(dataset.names))
    left_out = {*chosen.redundant.counters, *chosen.redundant.empty}
    for c, channel in enumerate(answers.names):
        assert np.isfinite(answers[0].values[:, c]).all() == (channel not in left_out)
    assert test[0].names == dataset.names


# --- of each kind ---------------------------------------------------------------------------------


def chosen_for(name: str):
    return plan(ODD_LOGS[name]())


def test_marks_of_missing_values_are_masked():
    dataset, chosen = ODD_LOGS["sentinels"](), chosen_for("sentinels")
    assert chosen.reader == {"outliers": "mask"}
    data = prepare(dataset, chosen)
    assert (~data[0].known).sum(axis=0).tolist() == [3, 2, 20]
    assert np.nanmax(np.abs(data[0].values)) < 40


def test_impacts_steps_a_gripper_and_a_set_point_are_kept_as_they_are():
    for name in ("impacts", "step_signal", "huge_offset", "tiny_scales", "noise_only"):
        dataset = ODD_LOGS[name]()
        chosen = plan(dataset)
        assert chosen.reader == {"outliers": "mask"}, name
        assert chosen.redundant == Redundant(), name
        data = prepare(dataset, chosen)
        assert np.array_equal(data[0].values, dataset[0].values), name


def test_constants_copies_and_counters_are_not_learned():
    assert chosen_for("constants").redundant == Redundant(constants={"gain": 7.25, "mode": 0.0})
    copies = {f"joints_filtered.q{c}": f"joints.q{c}" for c in range(3)}
    assert chosen_for("duplicate_topics").redundant == Redundant(copies=copies)
    counted = chosen_for("counters").redundant
    assert counted == Redundant(counters=("seq", "frame", "stamp"))


def test_sensors_are_the_channels_that_report_together():
    sensors = (("q0", "q1", "q2"), ("ax", "ay", "az"), ("grip",))
    chosen = chosen_for("multi_rate")
    assert chosen.sensors == chosen.split.sensors == sensors
    assert chosen.split.mask == "dropout"
    assert chosen_for("late_sensor").sensors == (("q0", "q1"), ("q2",))
    assert chosen_for("sentinels").sensors == (("q0",), ("q1",), ("q2",)), "all report together"


def test_a_few_masked_values_separate_no_channel_from_its_sensor():
    times = at(50, 40)
    values = motion(times)
    values[::3, 2] = np.nan
    values[[4, 77, 900], 0] = np.nan
    assert find_sensors(log(times, values)) == (("q0", "q1"), ("q2",))


def test_bursts_and_dropouts_are_silences():
    bursts = chosen_for("bursts")
    assert bursts.typical_gap_s == pytest.approx(0.01)
    assert bursts.silence_s == bursts.longest_silence_s == pytest.approx(0.41)
    assert bursts.horizon_s == pytest.approx(0.41)
    assert bursts.split.mask == "bursts"
    long = chosen_for("long_dropouts")
    assert long.longest_silence_s == pytest.approx(6.0, rel=0.01)
    assert long.horizon_s == 1.0


def test_windows_are_three_times_the_longest_silence_where_the_log_has_room():
    times = at(20, 400)
    values = motion(times)
    values[:, [2]] = out(times, values[:, [2]], [(100, 107), (300, 302)])
    chosen = plan(log(times, values))
    assert chosen.longest_silence_s == pytest.approx(7.05)
    assert chosen.window_s == pytest.approx(3 * 7.05, rel=0.01)
    assert not [note for note in chosen.notes if "less than three times" in note]


def test_the_horizon_follows_the_motion():
    times = at(50, 120)
    slow, fast = (np.sin(2 * np.pi * rate * times)[:, None] for rate in (0.05, 1.0))
    # The correlation of a sine is 0.5 after a sixth of its period.
    assert plan(log(times, fast)).horizon_s == pytest.approx(2 / 6, abs=0.03)
    assert plan(log(times, slow)).horizon_s == 1.0
    assert chosen_for("noise_only").horizon_s == pytest.approx(5 * 0.02)


def test_a_horizon_that_is_asked_for_is_kept_and_judged():
    dataset = ODD_LOGS["long"]()
    chosen = plan(dataset, horizon_s=2.0)
    assert chosen.horizon_s == 2.0
    assert chosen.horizons_s == (0.2, 0.4, 1.0, 2.0)
    assert chosen.window_s >= 6.0
    far = plan(ODD_LOGS["short"](), horizon_s=1.0)
    assert any("too short to judge them" in note for note in far.notes)
    with pytest.raises(ob.InputError, match="horizon_s must be a positive number"):
        plan(dataset, horizon_s=-1.0)


def test_many_episodes_are_split_whole_and_few_are_not():
    many, two = chosen_for("many_episodes"), chosen_for("two_episodes")
    assert (many.split.by, two.split.by) == ("trajectory", "blocks")


def test_one_long_episode_beside_many_short_ones_is_split_itself():
    clocks = [at(50, 100), *(at(50, 3) for _ in range(12))]
    data = ob.Dataset(tuple(log(t, motion(t, i))[0] for i, t in enumerate(clocks)))
    assert plan(data).split.by == "blocks"


def test_motion_that_ends_half_way_is_in_every_part():
    dataset, chosen = ODD_LOGS["rest_at_the_end"](), chosen_for("rest_at_the_end")
    assert not [note for note in chosen.notes if "at rest" in note]
    in_time = plan(dataset, split=SplitConfig(by="time", window_s=1.0))
    assert any(note.startswith("the test part is at rest: q0, q1, q2") for note in in_time.notes)
    assert in_time.split == SplitConfig(by="time", window_s=1.0), "a split that is given is kept"


@pytest.mark.parametrize("start", [3, 20, 37, 50])
def test_a_single_manoeuvre_is_in_the_training_part_and_in_validation_where_it_can_be(start):
    times = at(50, 60)
    moving = (times >= start) & (times < start + 4)
    values = np.where(moving[:, None], motion(times), 0.0)
    values += 0.002 * np.random.default_rng(0).normal(size=values.shape)
    dataset = log(times, values)
    chosen = plan(dataset)
    whole = SplitConfig(
        by="blocks", blocks=chosen.split.blocks, gap_s=chosen.split.gap_s, seed=chosen.split.seed
    )
    rows = [sum(int((np.abs(t.values) > 0.1).any(axis=1).sum()) for t in part)
            for part in ob.apply_split(dataset, whole)]  # fmt: skip
    assert rows[0] > 40, "moving rows of the training part"
    lacking = [i for i in (1, 2) if rows[i] < 5]
    said = [note for note in chosen.notes if "is at rest" in note]
    assert len(said) >= len(lacking), "what is missing is said"
    others = [replace(whole, seed=1000 * k) for k in range(24)]
    least = min(unlikeness(*ob.apply_split(dataset, one)) for one in others)
    assert unlikeness(*ob.apply_split(dataset, whole)) == least


def test_a_channel_that_the_training_part_lacks_is_said_and_left_out():
    times = at(50, 60)
    values = motion(times)
    values[:, 2] = out(times, values[:, [2]], [(0, 55)])[:, 0]
    by_time = SplitConfig(by="time", window_s=1.0)
    chosen = plan(log(times, values), split=by_time)
    assert chosen.redundant.empty == ("q2",)
    assert any("without a value in the training part" in note for note in chosen.notes)
    train, _, _ = ob.apply_split(prepare(log(times, values), chosen), by_time)
    ob.make_model("gru", train, hidden_size=3)


def test_a_log_that_is_too_short_is_refused_in_one_line():
    times = at(10, 2)
    with pytest.raises(ob.InputError, match=r"20 rows are too few.*at least 24"):
        plan(log(times, motion(times)))


def test_options_that_are_given_are_kept():
    dataset = ODD_LOGS["sentinels"]()
    chosen = plan(dataset, reader={"outliers": "keep", "time_unit": "s"})
    assert chosen.reader == {"outliers": "keep", "time_unit": "s"}
    assert prepare(dataset, chosen)[0].known.all()
    assert plan(dataset, known=()).reader == {}, "a finished data set is not cleaned"


def test_a_plan_is_plain_data():
    for name in ("multi_rate", "constants", "counters"):
        record = json.loads(json.dumps(chosen_for(name).to_dict()))
        assert record["split"]["by"] == "blocks"
        assert SplitConfig(**record["split"]) == chosen_for(name).split


@pytest.mark.timeout(900)  # on a loaded machine
@pytest.mark.parametrize("name", ["short", "constants", "long_dropouts", "two_episodes"])
def test_the_printed_command_trains_and_its_run_answers(name, tmp_path, capsys):
    path = write_csv(ODD_LOGS[name](), tmp_path / "log.csv")
    run = tmp_path / "run"
    small = ["--model.name=gru", "--model.hidden_size=4", "--training.epochs=1"]
    assert main(["train", str(path), str(run), *small]) == 0
    for command in ("predict", "impute"):
        assert main([command, str(run), str(path), str(tmp_path / f"{command}.csv")]) == 0
    table = (tmp_path / "impute.csv").read_text().splitlines()
    assert len(table) == 1 + sum(t.rows for t in ODD_LOGS[name]())
    capsys.readouterr()
    assert main(["evaluate", str(run), str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["part"] == "test"
