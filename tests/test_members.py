"""The baselines of a blend in the time that there is: the cheap ones first, and none twice."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from task_helpers import SMALL, TASKS, TRAIN, VALIDATION

import offbeat as ob
from offbeat.baselines import BASELINES, members
from offbeat.baselines.members import fit_members
from offbeat.config import ModelConfig
from offbeat.data.tasks import draw_tasks
from offbeat.learning import SIMPLE, train_blend

NAMES = ("ridge", "last_value", "kalman_short", "damped_slope")
PARTS = [draw_tasks(data, TASKS, 12, seed=3) for data in (TRAIN, VALIDATION)]


@pytest.fixture
def slow_world(monkeypatch):
    """A fit takes as many seconds as its cost, and nothing else takes time."""
    world = SimpleNamespace(now=0.0)

    class Clock:
        def __init__(self) -> None:
            self.at = world.now

        def __sub__(self, earlier) -> float:
            return self.at - earlier.at

    def fit(name, tasks):
        world.now += BASELINES[name].cost
        return SimpleNamespace(flexible=False, predict=lambda asked: [name] * len(asked))

    monkeypatch.setattr(members, "Clock", Clock)
    monkeypatch.setattr(members, "fit_baseline", fit)
    return world


def test_the_cheap_ones_are_fitted_first_and_no_fit_ends_late(slow_world):
    cost = {name: BASELINES[name].cost for name in NAMES}
    few = cost["last_value"] + cost["damped_slope"]
    for budget_s, expected in (
        (0.0, ("last_value", "damped_slope")),
        (few + cost["kalman_short"] - 0.01, ("last_value", "damped_slope")),
        (few + cost["kalman_short"], ("last_value", "kalman_short", "damped_slope")),
        (sum(cost.values()), NAMES),
        (None, NAMES),
    ):
        slow_world.now = 0.0
        found = fit_members(NAMES, *PARTS, budget_s=budget_s)
        assert tuple(found) == expected, "in the order of the names"
        assert slow_world.now <= max(budget_s or np.inf, few)
    assert found["ridge"].train == ["ridge"] * 12


def test_the_cheapest_is_fitted_whatever_it_costs(slow_world):
    assert tuple(fit_members(("ridge", "kalman_short"), *PARTS, budget_s=0.0)) == ("kalman_short",)


def test_a_budget_that_suffices_changes_no_number():
    names = ("kalman_short", "last_value", "damped_slope")
    free, limited = (fit_members(names, *PARTS, budget_s=s) for s in (None, 1e9))
    assert tuple(free) == tuple(limited) == names
    for name in names:
        for kind in ("train", "validation"):
            pairs = zip(getattr(free[name], kind), getattr(limited[name], kind), strict=True)
            assert all(np.array_equal(a, b) for a, b in pairs)


def test_what_there_was_no_time_for_is_said_and_what_is_named_is_fitted():
    options = {
        "model": ModelConfig("gru", **SMALL),
        "training": ob.TrainConfig(epochs=1, tasks_per_epoch=8),
        "two_sided": False,
        "limit_s": 1e-3,
        "progress": False,
    }
    blend, _, notes = train_blend(TRAIN, VALIDATION, TASKS, **options)
    fitted = {*blend.stack.members, *blend.both.members}
    assert fitted == {*SIMPLE, "running_mean"}
    (said,) = [note for note in notes if note.startswith("not fitted")]
    for name in ("ridge", "kalman_short", "smoother", "ridge_fill"):
        assert name in said
    assert "residual_gru" not in said, "it is not fitted unless it is named"
    blend, _, notes = train_blend(
        TRAIN, VALIDATION, TASKS, baselines=["kalman_short", "smoother"], **options
    )
    assert {*blend.stack.members, *blend.both.members} == {"kalman_short", "smoother"}
    assert not [note for note in notes if note.startswith("not fitted")]
