import csv
import json
import multiprocessing
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from offbeat import demo
from offbeat.demo import ANCHORED, run_demo
from offbeat.errors import InputError, MissingExtraError, OffbeatError
from offbeat.models.zoo import THESIS_MODELS
from offbeat.plots import animation
from offbeat.sweeps import side_by_side
from offbeat.sweeps.engines.base import Ending

TINY = {"n_trajectories": 40, "epochs": 1, "anchored_epochs": 2, "progress": False}
PREDICTORS = {*THESIS_MODELS, ANCHORED, "last_value"}


def grey(backend, request, answer):
    """Stands in for rendering, which `test_report` tests and which takes longest."""
    width, height = animation._PANEL
    with np.load(request) as asked:
        np.save(answer, np.full((len(asked["truth"]), 2, height, width, 3), 128, dtype=np.uint8))


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch):
    monkeypatch.setattr(animation, "_render_with", grey)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, "_render_with", grey)
        return run_demo(tmp_path_factory.mktemp("demo") / "out", workers=1, **TINY)


@pytest.fixture
def copy(made, tmp_path):
    shutil.copytree(made.folder, tmp_path / "out")
    return tmp_path / "out"


def scores(folder):
    with (folder / "results.csv").open(newline="", encoding="utf-8") as file:
        return {line["model"]: line for line in csv.DictReader(file)}


def weights(folder):
    paths = folder.glob("models/*/model/model.safetensors")
    return {path.parent.parent.name: path.read_bytes() for path in paths}


def without_seconds(folder):
    return {
        name: {k: v for k, v in line.items() if k != "training_seconds"}
        for name, line in scores(folder).items()
    }


def test_every_predictor_has_a_line_of_results(made):
    lines = scores(made.folder)
    assert set(lines) == PREDICTORS
    assert list(lines["gru"]) == [
        "model",
        "steps",
        "epochs",
        "training_seconds",
        "after_first_observation_rmse",
        "masked_rmse",
        "after_first_row_rmse",
        "published_rmse",
        "under_trained",
    ]
    for name, line in lines.items():
        assert (
            float(line["after_first_observation_rmse"])
            == made.evaluation.scores[name].after_first_observation.rmse
        )
        assert float(line["published_rmse"]) == made.evaluation.scores[name].published.rmse
        assert line["under_trained"] == ("false" if name == "last_value" else "true")
    # 28 trajectories are one batch, so an epoch is a step.
    assert {name: (line["steps"], line["epochs"]) for name, line in lines.items()} == {
        **dict.fromkeys(THESIS_MODELS, ("1", "1")),
        ANCHORED: ("2", "2"),
        "last_value": ("0", "0"),
    }


def test_the_scores_are_also_written_as_json(made):
    written = json.loads((made.folder / "results.json").read_text(encoding="utf-8"))
    assert written == made.evaluation.to_dict()
    assert written["scaler"] == "divide_by_max"
    assert written["trajectories"] == 6


def test_the_report_names_every_predictor_and_every_file(made):
    text = str(made)
    lines = [line for line in text.splitlines() if line.split(" ")[0] in PREDICTORS]
    assert len(lines) == len(PREDICTORS)
    assert sum(" 1 of 7000 steps" in line for line in lines) == len(THESIS_MODELS)
    assert sum(" 2 of 2100 steps" in line for line in lines) == 1
    assert set(made.written) == {path.name for path in made.folder.iterdir()}
    assert all(name in text for name in made.written)


def test_a_machine_can_read_the_result(made):
    result = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert result["predictors"] == made.evaluation.to_dict()["predictors"]
    assert result["training"]["gru"]["steps"] == 1
    assert result["training"]["gru"]["under_trained"] is True
    assert "hopper.gif" in result["written"]


def test_a_model_trained_to_the_end_is_not_marked():
    history = (SimpleNamespace(steps=7000, seconds=60.0),)
    training = demo.Training(history, 7000)
    assert not training.under_trained
    assert training.note() == "7000 of 7000 steps, 60 s"


def test_both_animations_show_every_row_and_the_second_hides_its_latter_half(made):
    blue = []
    for name in ("hopper.gif", "hopper_extrapolation.gif"):
        with Image.open(made.folder / name) as gif:
            assert gif.n_frames == 100
            line = np.asarray(gif.convert("RGB"), dtype=int)[-20, 380:]
            blue.append((line[:, 2] - line[:, 0] > 100).sum())
    assert blue[0] > 10
    assert blue[1] == 0, "no row after the middle is observed"


def test_a_second_run_trains_nothing_and_finds_the_same(made, copy):
    logs = {path: path.read_bytes() for path in copy.glob("models/*/log.csv")}
    again = run_demo(copy, workers=1, **TINY)
    assert again.evaluation.to_dict() == made.evaluation.to_dict()
    assert (copy / "results.csv").read_bytes() == (made.folder / "results.csv").read_bytes()
    assert {path: path.read_bytes() for path in logs} == logs


def test_a_demo_that_was_stopped_goes_on_where_it_was(made, copy):
    shutil.rmtree(copy / "models" / "gru_d")
    (copy / "results.csv").unlink()
    shutil.rmtree(copy / "data")
    run_demo(copy, workers=1, **TINY)
    assert without_seconds(copy) == without_seconds(made.folder)


@pytest.mark.slow
def test_two_processes_train_the_same_models_as_one(made, tmp_path, capsys):
    run_demo(tmp_path / "two", workers=2, **TINY)
    assert weights(tmp_path / "two") == weights(made.folder)
    assert without_seconds(tmp_path / "two") == without_seconds(made.folder)
    assert capsys.readouterr().err == ""
    assert multiprocessing.active_children() == []


def test_an_error_in_a_process_that_trains_is_raised_here(copy):
    (copy / "settings.json").unlink()  # so that only the runs in the folder can tell
    with pytest.raises(InputError, match="holds another run"):
        run_demo(copy, workers=2, **{**TINY, "n_trajectories": 41})
    assert multiprocessing.active_children() == []


def test_a_process_that_was_killed_is_reported_with_what_to_do():
    lost = Ending(SimpleNamespace(name="gru"), lost=True)
    with pytest.raises(OffbeatError, match="trained 'gru' was killed; run the same again"):
        side_by_side.raise_failure(lost)


def test_other_settings_in_the_same_folder_change_nothing(copy):
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"seed \(0 then, 1 now\)"):
        run_demo(copy, seed=1, workers=1, **TINY)
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"epochs": 0}, "epochs must be an integer of at least 1, got 0"),
        ({"n_trajectories": 2}, "2 trajectories are too few"),
    ],
)
def test_arguments_out_of_bounds_are_refused_before_anything_is_written(tmp_path, options, said):
    with pytest.raises(InputError, match=said):
        run_demo(tmp_path / "out", **{**TINY, **options})
    assert not list(tmp_path.iterdir())


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="out is a file"):
        run_demo(tmp_path / "out", **TINY)
    assert (tmp_path / "out").read_text(encoding="utf-8") == "mine"


def test_where_nothing_renders_the_demo_says_so_and_writes_the_rest(copy, monkeypatch):
    def fail(*_, **__):
        raise MissingExtraError("MuJoCo cannot render here (egl: broken); install it")

    for gif in copy.glob("*.gif"):
        gif.unlink()
    monkeypatch.setattr(demo, "side_by_side", fail)
    result = run_demo(copy, workers=1, **TINY)
    assert "egl: broken" in str(result)
    assert not list(copy.glob("*.gif"))
    assert not any(name.endswith(".gif") for name in result.written)
    assert (copy / "predictions.png").exists()
