"""`sweep`: trains and scores any models over repeats that share windows, masks and splits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from offbeat.config import ModelConfig, SplitConfig, TrainConfig, check_seed
from offbeat.data.scaler import SCALERS, Scaler
from offbeat.data.splits import apply_split
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError, one_of
from offbeat.models.zoo import recipe_of, train_config
from offbeat.sweeps.fingerprint import fingerprint
from offbeat.sweeps.plan import Parts, Plan, Run
from offbeat.sweeps.provenance import provenance
from offbeat.sweeps.running import SweepResult, run_plan

if TYPE_CHECKING:
    from offbeat.models.base import BaseModel


@dataclass(frozen=True)
class SweepRun:
    """One training and its scores.

    Attributes:
        model: label of the model.
        repeat: counted from 0.
        epochs: passes over the training part.
        seed_draw: of windows, masks, split and batches: equal for the models of a repeat.
        seed_weights: of the initial weights.
    """

    model: str
    repeat: int
    epochs: int
    seed_draw: int
    seed_weights: int

    @property
    def run_id(self) -> str:
        """Name of the run and of its folder: `ode_rnn-r04`."""
        return f"{self.model}-r{self.repeat:02d}"


@dataclass(frozen=True)
class SweepPlan(Plan):
    """Models over repeats on one data set.

    Attributes:
        choices: label, configuration and training of each model.
        repeats: how many; repeat i has the seeds of `split` plus i.
        split: windows, masks and split.
        scaler_kind: fitted on the training part of a repeat.
    """

    grows: ClassVar[bool] = True

    choices: tuple[tuple[str, ModelConfig, TrainConfig], ...]
    repeats: int
    split: SplitConfig
    scaler_kind: str = "standardise"

    def runs(self) -> tuple[Run, ...]:
        """Ordered by repeat, so that an unfinished sweep can be compared."""
        seeds = [(i, self.split.seed + i) for i in range(self.repeats)]
        return tuple(
            SweepRun(label, i, recipe_of(model.name, training, validated=True).epochs, seed, seed)
            for i, seed in seeds
            for label, model, training in self.choices
        )

    def settings(self) -> Mapping[str, Any]:
        """Split and scaler."""
        return {"split": asdict(self.split), "scaler": self.scaler_kind}

    def models(self) -> Mapping[str, Any]:
        """Config and training of each model."""
        return {
            f"model {label}": {"model": asdict(model), "training": asdict(training)}
            for label, model, training in self.choices
        }

    def simulate(self, *, progress: bool) -> Dataset:
        """A sweep has no trajectories of its own."""
        raise InputError("a sweep needs a data set; give dataset=")

    def parts(self, recorded: Dataset, run: Run) -> Parts:
        """As `apply_split`, with the seed of the repeat."""
        return apply_split(recorded, replace(self.split, seed=run.seed_draw))

    def scaler(self, recorded: Dataset, train: Dataset) -> Scaler:
        """Fitted on the training part."""
        return Scaler.fit(self.scaler_kind, train)

    def model_config(self, label: str) -> ModelConfig:
        """Configuration of the model, as given."""
        return next(model for name, model, _ in self.choices if name == label)

    def train_config(self, run: Run) -> TrainConfig:
        """Configuration of the training, as given, with the seed of the repeat."""
        training = next(training for name, _, training in self.choices if name == run.model)
        return replace(training, seed=run.seed_draw)

    def provenance(self) -> dict[str, str]:
        """Provenance of this process at the first call."""
        return _provenance()

    def columns(
        self, run: Run, model: BaseModel, test: Dataset, recorded: Dataset
    ) -> dict[str, Any]:
        """The condition, equal for all runs."""
        split = self.split
        window = split.window if split.window_s is None else f"{split.window_s:g} s"
        said = [] if window is None else [f"window {window}"]
        if split.observed_fraction is not None:
            said.append(f"observed_fraction {split.observed_fraction:g}")
        return {"condition": ", ".join(said) or "whole trajectories"}


@cache
def _provenance() -> dict[str, str]:
    return provenance(fingerprint())


def sweep(
    dataset: Dataset,
    models: Sequence[str | ModelConfig] | Mapping[str, str | ModelConfig],
    *,
    out: str | Path,
    repeats: int = 5,
    split: SplitConfig = SplitConfig(),  # noqa: B008  # frozen
    training: TrainConfig | Mapping[str, TrainConfig] | None = None,
    epochs: int | None = None,
    scaler: str = "standardise",
    engine: str = "local",
    processes: int | None = None,
    threads: int = 1,
    device: str = "cpu",
    together: int | None = None,
    budget_minutes: float | None = None,
    mixed: str = "refuse",
    engine_options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> SweepResult:
    """Trains and scores models over repeats on any data, and keeps a record of all runs.

    In repeat i, every model is trained on the windows, masks and split that seed `split.seed + i`
    draws, so that `compare` can pair them. The call can be killed at any moment: the same call
    resumes and gives the same numbers. It can be repeated with more models and more repeats.

    Args:
        dataset: the trajectories.
        models: names or configurations; the keys of a mapping are labels. A registered model
            must be known to other processes, through an entry point of the group `offbeat.models`.
        out: folder: `record.parquet` and `.csv` (a line per run, the last-value predictor's scores
            among them), `curves.*` (a line per epoch), `status.json`, `data/`, `runs/`.
        repeats: how many.
        split: windows, masks and split; its seed is that of the first repeat.
        training: of all models, or by label; fields left at None follow the model's recipe. The
            weights with the best validation error are kept.
        epochs: replaces those of `training`.
        scaler: `standardise`, `robust`, `min_max`, `divide_by_max` or `identity`, fitted on the
            training part of each repeat.
        engine: `local`, `ray` or `slurm`; all give the same numbers. The workers of a cluster must
            see `out` under the same path.
        processes: runs at a time; by default as many as cores and memory allow.
        threads: of each run.
        device: that models are trained on: `cpu`, `cuda` or `cuda:1`; `auto`, of the local engine,
            takes a GPU where there is one.
        together: runs of equal shape that are trained in one process, whose steps are one launch
            (`offbeat.sweeps.together`); by default 32 on a GPU with the triton backend, else 1.
        budget_minutes: stop after this time, in the middle of runs; the next call resumes them.
        mixed: what to do with runs in `out` that were made by other code, on another processor,
            with another backend, torch or data: `refuse` to continue, `accept` or `redo` them.
        engine_options: arguments of `ray.init` and `gpus_per_run`, which may be a fraction; or of
            submitit's `update_parameters`.
        progress: show how far it is on standard error.

    Returns:
        The record; its `compare` tests which models differ.

    Raises:
        InputError: an argument is wrong, `out` belongs to another sweep or is in use, or runs would
            be mixed.
        DivergenceError: a training diverged; all other runs are finished.
        OffbeatError: a run failed otherwise, or lost its process three times.

    Example:
        >>> done = sweep(dataset, ["gru_d", "ode_rnn"], out="runs/sweep")  # doctest: +SKIP
        >>> print(done.compare().text())  # doctest: +SKIP
    """
    plan = SweepPlan(_choices(models, training, epochs), repeats, split, scaler)
    one_of("scaler", scaler, SCALERS)
    if not isinstance(repeats, int) or not 1 <= repeats <= 100:
        raise InputError(f"repeats must be an integer from 1 to 100, got {repeats!r}")
    check_seed(split.seed + repeats)
    return run_plan(
        plan,
        out,
        dataset,
        engine=engine,
        mixed=mixed,
        processes=processes,
        threads=threads,
        device=device,
        together=together,
        budget_minutes=budget_minutes,
        engine_options=engine_options,
        progress=progress,
    )


def _choices(
    models: Sequence[str | ModelConfig] | Mapping[str, str | ModelConfig],
    training: TrainConfig | Mapping[str, TrainConfig] | None,
    epochs: int | None,
) -> tuple[tuple[str, ModelConfig, TrainConfig], ...]:
    if isinstance(models, str):
        models = [models]
    configs = [ModelConfig(m) if isinstance(m, str) else m for m in _values(models)]
    labels = list(models) if isinstance(models, Mapping) else [c.name for c in configs]
    if not labels or len(set(labels)) < len(labels):
        raise InputError(
            f"models need labels that differ, got {', '.join(labels) or 'no model'}; give "
            "a mapping from label to config for several of one name"
        )
    for label in labels:
        if not label.replace("_", "").replace("-", "").replace(".", "").isalnum():
            raise InputError(
                f"the label {label!r} names a folder; use letters, digits, '_', '-' and '.'"
            )
    by_label = training if isinstance(training, Mapping) else dict.fromkeys(labels, training)
    for label in by_label:
        one_of("label of training", label, labels)
    found = []
    for label, config in zip(labels, configs, strict=True):
        given = asdict(by_label.get(label) or TrainConfig())
        asked = {name: value for name, value in given.items() if value is not None}
        asked |= {} if epochs is None else {"epochs": epochs}
        found.append((label, config, train_config(config.name, **{"keep": "best", **asked})))
    return tuple(found)


def _values(
    models: Sequence[str | ModelConfig] | Mapping[str, str | ModelConfig],
) -> list[str | ModelConfig]:
    return list(models.values()) if isinstance(models, Mapping) else list(models)
