"""Training: it learns, it is deterministic, and neither a kill nor a NaN loses anything."""

import csv
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import offbeat as ob
from offbeat.models.checkpoint import load_training_state, save_training_state
from offbeat.models.zoo import ZOO, train_config


def swinging(n: int = 12, rows: int = 20, seed: int = 0) -> ob.Dataset:
    """Pendulums of random phase, half of the values masked, each on its own times."""
    random = np.random.default_rng(seed)
    trajectories = []
    for _ in range(n):
        times = np.cumsum(random.uniform(0.02, 0.2, rows))
        phase = random.uniform(0, 2 * np.pi)
        values = np.stack([np.sin(3 * times + phase), np.cos(3 * times + phase)], axis=1)
        observed = random.random(values.shape) < 0.5
        trajectories.append(ob.Trajectory(times, values, observed, names=("sin", "cos")))
    return ob.Dataset(tuple(trajectories))


TRAIN, VALIDATION = swinging(12, seed=1), swinging(5, seed=2)
SMALL = {"hidden_size": 4, "field_units": (8,), "decoder_units": (8,)}


def weights(model: ob.Model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("name", sorted(ZOO))
def test_a_few_epochs_lower_the_loss_of_every_model(name):
    model = ob.make_model(name, TRAIN, seed=0)
    config = train_config(name, epochs=8, batch_size=4, learning_rate=0.01)
    history = ob.fit(model, TRAIN, config=config, progress=False).history
    assert history[-1].train_mse < history[0].train_mse


@pytest.mark.parametrize("optimizer", ["adamax", "adam", "adamw", "sgd"])
def test_every_optimizer_trains_and_the_same_seed_gives_the_same_weights(optimizer):
    results = []
    for _ in range(2):
        model = ob.make_model("gru", TRAIN, **SMALL)
        config = ob.TrainConfig(epochs=2, batch_size=5, optimizer=optimizer, clip_norm=0.5)
        ob.fit(model, TRAIN, config=config, progress=False)
        results.append(weights(model))
    assert same(*results)
    assert not same(results[0], weights(ob.make_model("gru", TRAIN, **SMALL)))


def test_the_seed_changes_the_order_of_the_batches():
    ends = []
    for seed in (0, 1):
        model = ob.make_model("gru", TRAIN, **SMALL)
        config = ob.TrainConfig(epochs=1, batch_size=5, seed=seed)
        ob.fit(model, TRAIN, config=config, progress=False)
        ends.append(weights(model))
    assert not same(*ends)


def test_cosine_decay_ends_near_zero_and_clipping_bounds_an_sgd_step():
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(epochs=2, batch_size=12, schedule="cosine", learning_rate=0.1)
    history = ob.fit(model, TRAIN, config=config, progress=False).history
    assert history[-1].learning_rate == pytest.approx(0.05)  # the last of two steps
    model = ob.make_model("gru", TRAIN, **SMALL)
    before = torch.cat([p.detach().flatten() for p in model.parameters()])
    config = ob.TrainConfig(
        epochs=1, batch_size=12, optimizer="sgd", learning_rate=1.0, clip_norm=0.01, loss_scale=1e4
    )
    ob.fit(model, TRAIN, config=config, progress=False)
    after = torch.cat([p.detach().flatten() for p in model.parameters()])
    assert float((after - before).norm()) == pytest.approx(0.01, rel=1e-3)


def test_the_log_has_a_line_per_epoch_with_the_validation_scores(tmp_path):
    model = ob.make_model("gru", TRAIN, **SMALL)
    result = ob.fit(
        model,
        TRAIN,
        VALIDATION,
        ob.TrainConfig(epochs=3, batch_size=5),
        out=tmp_path / "run",
        progress=False,
    )
    with (tmp_path / "run" / "log.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [int(line["epoch"]) for line in lines] == [1, 2, 3]
    assert [int(line["steps"]) for line in lines] == [3, 6, 9]
    scores = ob.evaluate(model, VALIDATION).scores["gru"]
    assert float(lines[-1]["validation_mse"]) == pytest.approx(
        scores.after_first_observation.mse, rel=1e-6
    )
    assert float(lines[-1]["validation_published_mse"]) == pytest.approx(
        scores.published.mse, rel=1e-6
    )
    assert result.steps == 9
    events = list((tmp_path / "run" / "tensorboard").glob("events*"))
    assert events, "TensorBoard is installed for the tests, so its log is written"


def test_early_stopping_stops_and_keep_best_leaves_the_best_weights():
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(epochs=60, batch_size=4, learning_rate=0.3, patience=2, keep="best")
    result = ob.fit(model, TRAIN, VALIDATION, config, progress=False)
    assert result.stopped_early
    assert len(result.history) < 60
    best = min(record.validation_mse for record in result.history)
    final = ob.evaluate(model, VALIDATION).scores["gru"].after_first_observation.mse
    assert final == pytest.approx(best, rel=1e-6)
    assert result.history[-1].validation_mse > best


def test_early_stopping_without_a_validation_part_is_refused():
    model = ob.make_model("gru", TRAIN, **SMALL)
    with pytest.raises(ob.InputError, match="validation set"):
        ob.fit(model, TRAIN, config=ob.TrainConfig(patience=3))


CHILD = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import offbeat as ob
from test_training import SMALL, TRAIN, VALIDATION
model = ob.make_model({name!r}, TRAIN, **{options!r})
ob.fit(model, TRAIN, VALIDATION, ob.TrainConfig(**{config!r}), out=Path({out!r}), progress=False)
"""


@pytest.mark.parametrize(
    ("name", "options", "config"),
    [
        ("ode_gru_d", {}, {"optimizer": "adamax", "keep": "best"}),
        ("gru", {"self_feeding": 0.5}, {"optimizer": "adam", "schedule": "cosine"}),
    ],
)
def test_a_run_killed_in_the_middle_of_an_epoch_ends_as_if_it_had_not_been(
    tmp_path, name, options, config
):
    options = {**SMALL, **options}
    # 12 steps per epoch, a checkpoint after every fifth: some of them inside an epoch.
    config = {"epochs": 40, "batch_size": 1, "checkpoint_every": 5, **config}
    whole = ob.make_model(name, TRAIN, **options)
    expected = ob.fit(whole, TRAIN, VALIDATION, ob.TrainConfig(**config), progress=False)

    out = tmp_path / "run"
    child = CHILD.format(
        tests=str(Path(__file__).parent), name=name, options=options, config=config, out=str(out)
    )
    process = subprocess.Popen([sys.executable, "-c", child])
    deadline = time.monotonic() + 120
    middle = None
    while middle is None and time.monotonic() < deadline and process.poll() is None:
        for folder in (out / "checkpoints").glob("steps-*"):
            steps = int(folder.name.removeprefix("steps-"))
            if steps > 12 and steps % 12:
                middle = steps
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "the run was over before it could be killed"
    assert middle is not None
    assert not (out / "model").exists()

    resumed = ob.make_model(name, TRAIN, **options)
    result = ob.fit(resumed, TRAIN, VALIDATION, ob.TrainConfig(**config), out=out, progress=False)
    assert same(weights(resumed), weights(whole))
    strip = [replace(record, seconds=0.0) for record in result.history]
    assert strip == [replace(record, seconds=0.0) for record in expected.history]
    assert same(weights(ob.load_model(out)), weights(whole))


def test_a_run_resumed_with_another_backend_says_so_with_both_names(tmp_path, caplog):
    def trained(epochs, backend):
        caplog.clear()
        config = ob.TrainConfig(epochs=epochs, batch_size=4)
        model = ob.make_model("gru", TRAIN, **SMALL)
        with ob.kernels.use(backend):
            ob.fit(model, TRAIN, config=config, out=tmp_path, progress=False)
            return model.backend()[0], [record.message for record in caplog.records]

    first, said = trained(1, "auto")
    assert said == []
    assert trained(2, "auto") == (first, [])
    other, said = trained(3, "reference")
    if first == other:
        pytest.skip("there is only one backend here")
    (line,) = said
    assert f"was trained with the backend {first}, and goes on with {other}" in line
    assert f"OFFBEAT_SCAN={first}" in line


def test_older_checkpoints_of_a_killed_run_are_removed_by_the_next_one(tmp_path):
    config = ob.TrainConfig(epochs=2, batch_size=4)
    first = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(first, TRAIN, config=config, out=tmp_path, progress=False)
    (newest,) = (tmp_path / "checkpoints").iterdir()
    for name in ("steps-000000001", "steps-000000002"):  # the second one is removed in part
        shutil.copytree(newest, newest.with_name(name))
    (newest.with_name("steps-000000002") / "config.json").unlink()
    again = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(again, TRAIN, config=config, out=tmp_path, progress=False)
    assert same(weights(first), weights(again))
    assert [*(tmp_path / "checkpoints").iterdir()] == [newest]


def test_a_finished_run_is_not_trained_again(tmp_path):
    config = ob.TrainConfig(epochs=2, batch_size=4)
    first = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(first, TRAIN, config=config, out=tmp_path, progress=False)
    log = (tmp_path / "log.csv").read_bytes()
    again = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(again, TRAIN, config=config, out=tmp_path, progress=False)
    assert same(weights(first), weights(again))
    assert (tmp_path / "log.csv").read_bytes() == log


def test_a_run_can_be_trained_for_longer_and_ends_as_one_that_was_planned_so(tmp_path):
    planned = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(planned, TRAIN, config=ob.TrainConfig(epochs=3, batch_size=4), progress=False)
    for epochs in (2, 3):
        longer = ob.make_model("gru", TRAIN, **SMALL)
        config = ob.TrainConfig(epochs=epochs, batch_size=4)
        ob.fit(longer, TRAIN, config=config, out=tmp_path, progress=False)
    assert same(weights(planned), weights(longer))
    with pytest.raises(ob.InputError, match="3 epochs already, 2 were requested"):
        ob.fit(
            ob.make_model("gru", TRAIN, **SMALL), TRAIN,
            config=ob.TrainConfig(epochs=2, batch_size=4), out=tmp_path, progress=False,
        )  # fmt: skip


def test_another_run_in_the_same_folder_is_refused_and_nothing_is_lost(tmp_path):
    config = ob.TrainConfig(epochs=1, batch_size=4)
    model = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(model, TRAIN, config=config, out=tmp_path, progress=False)
    before = weights(ob.load_model(tmp_path))
    other = ob.TrainConfig(epochs=1, batch_size=4, learning_rate=0.5)
    with pytest.raises(ob.InputError, match=r"learning_rate 0.001 then, 0.5 now"):
        ob.fit(
            ob.make_model("gru", TRAIN, **SMALL), TRAIN, config=other, out=tmp_path, progress=False
        )
    again = ob.make_model("gru", TRAIN, seed=1, **SMALL)
    with pytest.raises(ob.InputError, match="initial weights"):
        ob.fit(again, TRAIN, config=config, out=tmp_path, progress=False)
    with pytest.raises(ob.InputError, match=r"training set differ.*trajectories"):
        ob.fit(
            ob.make_model("gru", TRAIN, **SMALL),
            swinging(9),
            config=config,
            out=tmp_path,
            progress=False,
        )
    assert same(weights(ob.load_model(tmp_path)), before)


def test_a_loss_that_turns_to_nan_names_epoch_and_step_and_keeps_the_last_checkpoint(
    tmp_path, monkeypatch
):
    """Weights are poisoned after the seventh step; three steps make an epoch."""
    import offbeat.training as training

    steps = 0
    step = training.train_step

    def poisoned(model, *args, **kwargs):
        nonlocal steps
        loss = step(model, *args, **kwargs)
        steps += 1
        if steps == 7:
            with torch.no_grad():
                next(model.parameters()).fill_(float("nan"))
        return loss

    monkeypatch.setattr(training, "train_step", poisoned)
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(epochs=5, batch_size=4, keep="last")
    with pytest.raises(ob.DivergenceError, match=r"nan in epoch 3, step 2.*last good checkpoint"):
        ob.fit(model, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    kept = sorted((tmp_path / "checkpoints").iterdir())
    assert [folder.name for folder in kept] == ["steps-000000006"]
    monkeypatch.setattr(training, "train_step", step)
    again = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(again, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert all(bool(torch.isfinite(p).all()) for p in again.parameters())


def poisoned_at(monkeypatch, *steps_with_nan):
    """Makes the weights NaN after some training steps; returns the steps' learning rates."""
    import offbeat.training as training

    rates, step = [], training.train_step

    def poisoned(model, examples, index, state, *args, **kwargs):
        loss = step(model, examples, index, state, *args, **kwargs)
        rates.append(state.optimizer.param_groups[0]["lr"])
        if len(rates) in steps_with_nan:
            with torch.no_grad():
                next(model.parameters()).fill_(float("nan"))
        return loss

    monkeypatch.setattr(training, "train_step", poisoned)
    return rates


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_after_a_divergence_the_best_weights_are_trained_on_at_half_the_rate(
    schedule, monkeypatch, tmp_path
):
    config = ob.TrainConfig(epochs=4, batch_size=4, schedule=schedule)
    planned = ob.make_model("gru", TRAIN, **SMALL)
    rates = poisoned_at(monkeypatch)
    ob.fit(planned, TRAIN, VALIDATION, config, progress=False)
    monkeypatch.undo()
    halved = poisoned_at(monkeypatch, 7)  # three steps make an epoch
    model = ob.make_model("gru", TRAIN, **SMALL)
    result = ob.fit(model, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert [record.epoch for record in result.history] == [1, 2, 3, 4]
    assert result.diverged == ""
    # The seventh step poisons, the loss of the eighth is NaN, and the third epoch starts anew.
    assert halved[:7] == rates[:7]
    assert halved[7:] == [rate / 2 for rate in rates[6:]]
    again = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(again, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert same(weights(again), weights(model))


def test_a_training_that_diverges_twice_ends_with_its_best_weights_and_says_so(
    monkeypatch, tmp_path
):
    kept = []
    config = ob.TrainConfig(epochs=5, batch_size=4)
    poisoned_at(monkeypatch, 7, 9)
    model = ob.make_model("gru", TRAIN, **SMALL)
    result = ob.fit(
        model, TRAIN, VALIDATION, config, out=tmp_path, progress=False,
        callbacks=[lambda record, model: kept.append(weights(model))],
    )  # fmt: skip
    assert "diverged twice (epoch 3)" in result.diverged
    assert result.stopped_early
    assert len(kept) == 2
    assert same(weights(model), kept[result.best_epoch - 1])
    assert same(weights(ob.load_model(tmp_path)), weights(model))
    monkeypatch.undo()
    again = ob.make_model("gru", TRAIN, **SMALL)
    assert ob.fit(again, TRAIN, VALIDATION, config, out=tmp_path, progress=False).diverged
    assert same(weights(again), weights(model))


def test_two_trainings_in_one_folder_at_once_end_in_one_line_and_a_dead_one_holds_no_lock(tmp_path):
    config = ob.TrainConfig(epochs=1, batch_size=4)
    script = (
        "import sys, time; from pathlib import Path; from offbeat.run import locked\n"
        "with locked(Path(sys.argv[1])): print('locked', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "locked\n"
        model = ob.make_model("gru", TRAIN, **SMALL)
        with pytest.raises(ob.InputError, match=f"process {other.pid} trains there; wait"):
            ob.fit(model, TRAIN, config=config, out=tmp_path, progress=False)
    finally:
        other.kill()
        other.communicate()
    assert ob.fit(model, TRAIN, config=config, out=tmp_path, progress=False).steps == 3


def test_a_learning_rate_that_explodes_is_reported_as_a_divergence():
    model = ob.make_model("ode_rnn", TRAIN, **SMALL)
    config = ob.TrainConfig(epochs=30, optimizer="sgd", learning_rate=1e30, batch_size=4)
    with pytest.raises(ob.DivergenceError, match="lower the learning rate"):
        ob.fit(model, TRAIN, config=config, progress=False)


@pytest.mark.parametrize("name", ["gru", "anchored_ode_gru_d"])
def test_a_checkpoint_gives_the_same_predictions_bit_for_bit(tmp_path, name):
    model = ob.make_model(name, TRAIN, **SMALL)
    ob.fit(model, TRAIN, config=ob.TrainConfig(epochs=1), progress=False)
    ob.save_model(model, tmp_path / "saved")
    loaded = ob.load_model(tmp_path / "saved")
    expected, got = ob.predict(model, VALIDATION), ob.predict(loaded, VALIDATION)
    assert all(np.array_equal(a.values, b.values) for a, b in zip(expected, got, strict=True))
    assert loaded.config == model.config
    assert loaded.time_unit == model.time_unit


@pytest.mark.parametrize("file", ["model.safetensors", "config.json"])
def test_a_checkpoint_with_one_flipped_byte_is_refused(tmp_path, file):
    folder = tmp_path / "saved"
    ob.save_model(ob.make_model("gru", TRAIN, **SMALL), folder)
    whole = (folder / file).read_bytes()
    for position in np.linspace(0, len(whole) - 2, 40).astype(int):
        damaged = bytearray(whole)
        damaged[position] ^= 1
        (folder / file).write_bytes(bytes(damaged))
        with pytest.raises(ob.FileFormatError, match=r"damaged|not an Offbeat|version"):
            ob.load_model(folder)
    (folder / file).write_bytes(whole)
    ob.load_model(folder)


def test_a_folder_that_is_no_checkpoint_or_a_newer_one_is_refused(tmp_path):
    with pytest.raises(ob.FileFormatError, match="not a checkpoint"):
        ob.load_model(tmp_path / "nothing")
    folder = tmp_path / "saved"
    ob.save_model(ob.make_model("gru", TRAIN, **SMALL), folder)
    record = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**record, "version": 3}))
    with pytest.raises(ob.FileFormatError, match="checkpoint version 3"):
        ob.load_model(folder)


# --- what must be equal to resume a run -----------------------------------------------------------


def _bursts(data):
    return ob.mask_out(data, 0.5, mask="bursts", burst_rows=4, seed=3)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (lambda d: ob.mask_out(d, 0.5, seed=4), "training set"),
        (_bursts, "training set"),
        (lambda d: d.take(range(len(d) - 1, -1, -1)), "training set"),
        (
            lambda d: ob.Dataset(
                tuple(replace(t, units=("furlong",) * t.channels) for t in d), d.meta
            ),
            "training set",
        ),
    ],
    ids=["another mask", "bursts", "another order", "another unit"],
)
def test_a_run_does_not_go_on_with_other_training_data(changed, message, tmp_path):
    """In 0.1.0 only counts and sums were compared, so these were resumed silently."""
    whole = swinging(8)
    data = ob.mask_out(whole, 0.5, seed=3)
    config = ob.TrainConfig(epochs=1, batch_size=4)
    model = ob.make_model("gru", data, **SMALL)
    ob.fit(model, data, config=config, out=tmp_path, progress=False)
    before = weights(ob.load_model(tmp_path))
    other = changed(data if "order" in message else whole)
    if other.units != data.units:
        other = changed(data)
    again = ob.make_model("gru", data, **SMALL)
    again.units = other.units
    more = ob.TrainConfig(epochs=2, batch_size=4)
    with pytest.raises(ob.InputError, match=message):
        ob.fit(again, other, config=more, out=tmp_path, progress=False)
    assert same(weights(ob.load_model(tmp_path)), before)


def test_a_run_does_not_go_on_with_another_validation_set(tmp_path):
    config = ob.TrainConfig(epochs=1, batch_size=4)
    ob.fit(
        ob.make_model("gru", TRAIN, **SMALL), TRAIN, VALIDATION, config, out=tmp_path,
        progress=False,
    )  # fmt: skip
    other = ob.mask_out(VALIDATION, 0.5, seed=1)
    with pytest.raises(ob.InputError, match="validation set"):
        ob.fit(
            ob.make_model("gru", TRAIN, **SMALL), TRAIN, other,
            ob.TrainConfig(epochs=2, batch_size=4), out=tmp_path, progress=False,
        )  # fmt: skip


def test_a_run_whose_checkpoint_does_not_say_on_which_data_is_not_resumed(tmp_path):
    """Those of 0.1.0 have counts and sums alone."""
    config = ob.TrainConfig(epochs=1)
    model = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(model, TRAIN, config=config, out=tmp_path, progress=False)
    (checkpoint,) = (tmp_path / "checkpoints").iterdir()
    _, tensors, record = load_training_state(checkpoint)
    del record["identity"]["train"]["fingerprint"]
    save_training_state(model, tensors, record, checkpoint)
    with pytest.raises(ob.InputError, match=r"a run of Offbeat 0\.1.* give another folder"):
        ob.fit(ob.make_model("gru", TRAIN, **SMALL), TRAIN, out=tmp_path, progress=False)


def test_a_run_goes_on_after_a_version_that_added_options(tmp_path):
    """What the checkpoint does not name, it did as the default of the option does today."""
    config = ob.TrainConfig(epochs=1)
    ob.fit(ob.make_model("gru", TRAIN, **SMALL), TRAIN, config=config, out=tmp_path, progress=False)
    (checkpoint,) = (tmp_path / "checkpoints").iterdir()
    model = ob.load_model(tmp_path)
    _, tensors, record = load_training_state(checkpoint)
    for part, names in {"model": ("trend", "bounded"), "training": ("redraw", "loss")}.items():
        for name in names:
            del record["identity"][part][name]
    save_training_state(model, tensors, record, checkpoint)
    more = ob.TrainConfig(epochs=2)
    made = ob.make_model("gru", TRAIN, **SMALL)
    result = ob.fit(made, TRAIN, config=more, out=tmp_path, progress=False)
    assert len(result.history) == 2

    other = ob.make_model("gru", TRAIN, **SMALL)
    relative = ob.TrainConfig(epochs=3, loss="relative")
    with pytest.raises(ob.InputError, match="loss 'head' then, 'relative' now"):
        ob.fit(other, TRAIN, config=relative, out=tmp_path, progress=False)


# --- recipes, devices, callbacks ------------------------------------------------------------------


def test_without_a_config_a_model_trains_with_its_own_recipe():
    recipes = {
        name: ob.fit(
            ob.make_model(name, TRAIN, **SMALL), TRAIN, VALIDATION, ob.TrainConfig(epochs=1),
            progress=False,
        ).recipe
        for name in ("gru", "anchored_ode_gru_d")
    }  # fmt: skip
    gru, anchored = recipes["gru"], recipes["anchored_ode_gru_d"]
    assert (gru.optimizer, gru.learning_rate, gru.schedule) == ("adamax", 1e-3, "constant")
    assert (anchored.optimizer, anchored.learning_rate) == ("adam", 2e-3)
    assert (anchored.schedule, anchored.clip_norm) == ("cosine", 1.0)
    assert {r.keep for r in recipes.values()} == {"best"}, "there is a validation set"
    alone = ob.fit(
        ob.make_model("gru", TRAIN, **SMALL), TRAIN, config=ob.TrainConfig(epochs=1), progress=False
    )
    assert alone.recipe.keep == "last"


def test_what_is_asked_for_replaces_the_recipe():
    asked = ob.TrainConfig(epochs=1, optimizer="sgd", clip_norm=math.inf, keep="last")
    model = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
    recipe = ob.fit(model, TRAIN, VALIDATION, asked, progress=False).recipe
    assert (recipe.optimizer, recipe.clip_norm, recipe.keep) == ("sgd", None, "last")
    assert recipe.learning_rate == 2e-3


def test_a_validation_set_of_which_nothing_counts_is_refused():
    """0.1.0 kept the last weights in silence."""
    once = ob.Dataset(
        tuple(replace(t, observed=np.zeros_like(t.observed)) for t in swinging(3)), {}
    )
    with pytest.raises(ob.InputError, match="no value of the validation set counts"):
        ob.fit(
            ob.make_model("gru", TRAIN, **SMALL), TRAIN, once,
            ob.TrainConfig(epochs=1, keep="best"), progress=False,
        )  # fmt: skip
    result = ob.fit(
        ob.make_model("gru", TRAIN, **SMALL), TRAIN, once, ob.TrainConfig(epochs=1), progress=False
    )
    assert math.isnan(result.history[-1].validation_mse)
    assert result.recipe.keep == "last"


def test_where_nothing_of_the_validation_set_counts_the_recipe_says_that_the_last_is_kept():
    once = ob.Dataset(
        tuple(replace(t, observed=np.zeros_like(t.observed)) for t in swinging(3)), {}
    )
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(epochs=1)
    assert ob.fit(model, TRAIN, once, config, progress=False).recipe.keep == "last"
    assert ob.fit(model, TRAIN, VALIDATION, config, progress=False).recipe.keep == "best"


def test_a_callback_sees_every_epoch_and_can_stop():
    seen = []

    def callback(record, model):
        seen.append((record.epoch, model.name))
        return record.epoch == 2

    result = ob.fit(
        ob.make_model("gru", TRAIN, **SMALL), TRAIN, config=ob.TrainConfig(epochs=5),
        callbacks=[callback], progress=False,
    )  # fmt: skip
    assert seen == [(1, "gru"), (2, "gru")]
    assert result.stopped_early


def test_a_device_is_named_and_the_model_stays_there():
    model = ob.make_model("gru", TRAIN, **SMALL)
    ob.fit(model, TRAIN, config=ob.TrainConfig(epochs=1), device="cpu", progress=False)
    assert model.device.type == "cpu"
    with pytest.raises(ob.InputError, match="device 'gpu'"):
        ob.fit(model, TRAIN, config=ob.TrainConfig(epochs=1), device="gpu", progress=False)


def test_a_checkpoint_records_the_backend_that_ran(tmp_path):
    """0.1.0 recorded the instruction set of the processor although the reference ran."""
    model = ob.make_model("ode_rnn", TRAIN, **SMALL, solver="dopri5")
    ob.fit(model, TRAIN, config=ob.TrainConfig(epochs=1), out=tmp_path, progress=False)
    (folder,) = (tmp_path / "checkpoints").iterdir()
    assert json.loads((folder / "config.json").read_text())["training"]["backend"] == "reference"


@pytest.mark.slow
def test_the_default_model_beats_the_last_value_on_hopper_with_no_options():
    recorded = ob.simulate("hopper", n_trajectories=200, rows=100, seed=0)
    train, validation, test = ob.split(ob.mask_out(recorded, 0.3, seed=0), seed=0)
    model = ob.make_model(ob.ModelConfig(), train)
    result = ob.fit(model, train, validation, progress=False)
    assert result.steps <= 700
    scores = ob.evaluate({"model": model}, test).scores
    rmse = {name: s.after_first_observation.rmse for name, s in scores.items()}
    assert rmse["model"] < 0.9 * rmse["last_value"]
