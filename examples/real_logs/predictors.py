"""Predictors: each is fitted to the training part of a log and then asked the tasks.

A predictor has `causal` and `predict(dataset)`, as every baseline of `offbeat.baselines`. It may
have `quantiles(dataset, levels)`, (rows, channels, levels) per trajectory in original units; then
its intervals are scored. To add one, write a function that makes it and put it into `PREDICTORS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import offbeat as ob
from offbeat.answers.answer import Answer
from offbeat.answers.blend import TASKS, Blend, fit_blend, model_fills
from offbeat.baselines import BASELINES, fit_baseline
from offbeat.learning import train_blend

from .logs import Log

Array = NDArray[np.float64]
MODEL = "anchored_ode_gru_d"
BUDGET_S = 60.0
"""s, for the trainings of a log, on one thread."""


UNFITTED = ("last_value", "mean", "constant_velocity", "linear", "pchip")
"""Baselines that have nothing but the training mean; they are run once, not once per seed."""

ORACLE = ("last_value", "constant_velocity", "mean")
"""The best of these in hindsight is the first yardstick of the causal tasks."""

ORACLE_TWO_SIDED = (*ORACLE, "linear", "pchip")
"""The same for fills that use both sides."""


class Predictor(Protocol):
    """What is asked the tasks."""

    @property
    def causal(self) -> bool:
        """Whether a prediction uses only what was observed before its row."""

    def predict(self, dataset: ob.Dataset) -> list[Array]:
        """Predicts every row: (rows, channels) per trajectory, in original units."""


@dataclass(frozen=True)
class Causal:
    """A model, asked for each row from the rows before it.

    Attributes:
        model: trained.
    """

    model: ob.BaseModel
    causal = True

    def predict(self, dataset: ob.Dataset) -> list[Array]:
        """See `Predictor`."""
        return [t.values for t in ob.predict(self.model, dataset)]


@dataclass(frozen=True)
class BothSides:
    """A forward and a backward model joined, asked to fill what is not observed.

    Attributes:
        blend: with both models.
    """

    blend: Blend
    causal = False

    def predict(self, dataset: ob.Dataset) -> list[Array]:
        """See `Predictor`."""
        fills = model_fills(self.blend.forward, self.blend.backward, dataset)
        assert fills is not None
        return fills


class Blended:
    """A blend, whose answers have intervals.

    Args:
        blend: fitted.
        causal: predicts each row from the rows before it, else fills from both sides.
    """

    def __init__(self, blend: Blend, *, causal: bool) -> None:
        self.blend, self.causal = blend, causal
        self._asked: tuple[ob.Dataset, list[Answer]] | None = None

    def answers(self, dataset: ob.Dataset) -> list[Answer]:
        """The answers; those to the data set that was asked last are kept."""
        if self._asked is None or self._asked[0] is not dataset:
            found = self.blend.causal(dataset) if self.causal else self.blend.fill(dataset)
            self._asked = dataset, found
        return self._asked[1]

    def predict(self, dataset: ob.Dataset) -> list[Array]:
        """See `Predictor`."""
        return [answer.values for answer in self.answers(dataset)]

    def quantiles(self, dataset: ob.Dataset, levels: Array) -> list[Array]:
        """(rows, channels, levels) per trajectory: the ends of central intervals."""

        def end(answer: Answer, level: float) -> Array:
            inside = abs(2 * level - 1)
            half = answer.half_width(inside) if inside > 1e-9 else 0.0
            return answer.values + np.sign(level - 0.5) * half

        return [np.stack([end(a, p) for p in levels], axis=2) for a in self.answers(dataset)]


@dataclass(frozen=True)
class Entry:
    """A way to make predictors.

    Attributes:
        make: (log, seed, quick) to fitted predictors by name.
        names: of them.
        once: whether they do not depend on the seed.
    """

    make: Callable[[Log, int, bool], Mapping[str, Predictor]]
    names: tuple[str, ...]
    once: bool = False


def baseline(name: str) -> Entry:
    """A baseline of the registry.

    Args:
        name: of `offbeat.baselines.BASELINES`.
    """

    def make(log: Log, seed: int, quick: bool) -> Mapping[str, Predictor]:
        if name in UNFITTED:
            return {name: fit_baseline(name, log.training_windows)}
        tasks = log.fitting_tasks(causal=BASELINES[name].causal, seed=seed)
        return {name: fit_baseline(name, tasks)}

    return Entry(make, (name,), once=name in UNFITTED)


def offbeat(log: Log, seed: int, quick: bool) -> Mapping[str, Predictor]:
    """The blend of baselines and models, as `offbeat.learn` trains it, and its models alone.

    Args:
        log: to train on.
        seed: of the initial weights and of the tasks.
        quick: two epochs of one model and a few baselines, for tests.
    """
    options: dict[str, Any] = {"as_it_is": bool(log.masked), "seed": seed, "progress": False}
    options["budget_s"] = BUDGET_S
    options["baselines"] = [name for name, kind in BASELINES.items() if not kind.slow]
    if quick:
        options |= {"model": MODEL, "training": ob.TrainConfig(epochs=2, seed=seed)}
        options["baselines"] = ["last_value", "ridge", "linear", "pchip"]
        if not log.masked:
            options["training"] = ob.TrainConfig(epochs=2, seed=seed, tasks_per_epoch=32)
    blend, _, _ = train_blend(log.train, log.validation, log.task_config, **options)
    assert blend.forward is not None
    return {
        "offbeat": Blended(blend, causal=True),
        "offbeat_two_sided": Blended(blend, causal=False),
        "offbeat_model": Causal(blend.forward),
        "offbeat_models_two_sided": BothSides(blend),
    }


def blend_of_baselines(log: Log, seed: int, quick: bool) -> Mapping[str, Predictor]:
    """A blend of baselines without a model.

    Args:
        log: to fit to.
        seed: of the tasks that are drawn.
        quick: fewer tasks, for tests.
    """
    blend = fit_blend(
        log.train,
        log.validation,
        tasks=log.task_config,
        masks_of_data=bool(log.masked),
        count=100 if quick else log.drawn_tasks or TASKS,
        seed=seed,
    )
    return {
        "offbeat_blend": Blended(blend, causal=True),
        "offbeat_blend_two_sided": Blended(blend, causal=False),
    }


PREDICTORS: dict[str, Entry] = {name: baseline(name) for name in BASELINES} | {
    "offbeat_blend": Entry(blend_of_baselines, ("offbeat_blend", "offbeat_blend_two_sided")),
    "offbeat": Entry(
        offbeat,
        ("offbeat", "offbeat_two_sided", "offbeat_model", "offbeat_models_two_sided"),
    ),
}
"""Predictors by name, in the order of the tables."""
