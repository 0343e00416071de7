"""A ladder of models: a few are trained shortly on tasks, and the best on validation in full."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from offbeat.baselines import BASELINES, Baseline, CausalBaseline
from offbeat.config import ModelConfig, TrainConfig, check_seed, from_mapping
from offbeat.data.scaler import Scaler, ScalerKind
from offbeat.data.trajectory import Dataset
from offbeat.distributed import current
from offbeat.errors import DivergenceError, FileFormatError, InputError
from offbeat.examples import fitted_baselines, number_of_tasks, ordered, reference_tasks
from offbeat.files import writable, write_json
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import save_model
from offbeat.models.corrected import CorrectedModel
from offbeat.models.model import Model
from offbeat.models.zoo import make_model, recipe_of
from offbeat.progress import Clock
from offbeat.run import LADDER
from offbeat.training import FitResult, fit

PLAN = "plan.json"
"""File of the plan and of the results in the folder `ladder` of a run."""

TRIAL_EPOCHS = (2, 8)
"""Least and most epochs of a trial."""

EPOCHS = (6, 40)
"""Least and most epochs of the final training."""

OVERHEAD = 1.2
"""Time of an epoch in times of its steps and of the drawing of their tasks: also validation."""

_TIMED_STEPS = 16


@dataclass(frozen=True)
class Candidate:
    """A model to try.

    Attributes:
        model: what it consists of.
        learning_rate: of its training.
        corrects: name of the baseline that it corrects; None for a model by itself.
    """

    model: ModelConfig
    learning_rate: float = 0.003
    corrects: str | None = None

    @property
    def label(self) -> str:
        """Its name in messages and folders."""
        base = f"-on-{self.corrects}" if self.corrects else ""
        return f"{self.model.name}{base}-{self.model.hidden_size}-{self.learning_rate:g}"


def _anchored(name: str, rate: float, corrects: str | None = "damped_slope") -> Candidate:
    return Candidate(ModelConfig(name, hidden_size=32, field_units=(64, 64)), rate, corrects)


CANDIDATES = (
    _anchored("anchored_ode_gru_d", 0.006),
    _anchored("anchored_trend", 0.006),
    _anchored("anchored_trend", 0.006, None),
    _anchored("anchored_ode_gru_d", 0.002),
)
"""Candidates in the order in which they are tried; where the budget is short, the first ones."""


@dataclass(frozen=True)
class Trial:
    """A candidate, and how it did.

    Attributes:
        candidate: that was tried.
        seconds_per_step: s, with the drawing of its tasks, measured before the trials; 0 where it
            was not.
        epochs: of the final training, if it is chosen.
        score: validation score after the trial, see `ErrorTable.relative`; infinite where the
            training diverged; NaN before the trial.
    """

    candidate: Candidate
    seconds_per_step: float
    epochs: int
    score: float = math.nan


@dataclass(frozen=True)
class LadderResult:
    """A trained model, and the trials that led to it.

    Attributes:
        model: trained.
        fit: its training.
        trials: in the order of trial.
        trial_epochs: epochs of each trial.
        chosen: position of the best trial.
        config: of the final training; a backward model can be trained with it too.
    """

    model: BaseModel
    fit: FitResult
    trials: tuple[Trial, ...]
    trial_epochs: int
    chosen: int
    config: TrainConfig

    @property
    def score(self) -> float:
        """Validation score of the model."""
        return min(self.fit.validation_score, self.trials[self.chosen].score)


def fit_ladder(
    train: Dataset,
    validation: Dataset,
    config: TrainConfig,
    *,
    candidates: Sequence[Candidate] = CANDIDATES,
    budget_s: float | None = 300.0,
    out: str | Path | None = None,
    scaler: ScalerKind | Scaler = "standardise",
    baselines: Sequence[Baseline] | None = None,
    seed: int = 0,
    device: str | None = None,
    progress: bool = True,
) -> LadderResult:
    """Trains each candidate for a few epochs, and the best one on validation in full.

    The numbers of epochs follow from the budget and from the time of a step, which is measured once
    at the start and kept in `out`: half of the budget is for the trials, half for the final
    training. A run that was stopped is resumed with those numbers, and ends in the same model.

    Args:
        train: trajectories, as logged.
        validation: other trajectories, which choose.
        config: with the tasks. Learning rates are those of the candidates; epochs, where they are
            given, those of the final training.
        candidates: to try, the most promising first.
        budget_s: s, of all trainings; None tries every candidate for the most epochs.
        out: folder of the run, as of `fit`; trials are in its subfolder `ladder`.
        scaler: as of `make_model`.
        baselines: as of `fit`, fitted; also those that candidates correct, where they are among
            them.
        seed: of the initial weights.
        device: as of `fit`.
        progress: show progress bars.

    Raises:
        InputError: no tasks or no candidates, or as `fit`.
        DivergenceError: every candidate diverged.
        FileFormatError: the plan in `out` is damaged.
    """
    train, validation = Dataset.of(train), Dataset.of(validation)
    check_seed(seed)
    if config.tasks is None or not candidates:
        raise InputError("a ladder needs tasks (TrainConfig.tasks) and at least one candidate")
    if budget_s is not None and not 0 < budget_s < math.inf:
        raise InputError(f"budget_s must be a positive number of seconds, got {budget_s!r}")
    folder = writable(out, folder=True) if out is not None else None
    if current() is not None:
        raise InputError(
            "several ranks train one model, and the choice among models goes by their time; give "
            "the model, such as --model.name anchored_trend"
        )
    ladder = _Ladder(train, validation, config, scaler, baselines, seed, device, progress)
    trials, trial_epochs = ladder.plan(candidates, budget_s, folder)
    trained: list[BaseModel] = []
    for i, trial in enumerate(trials):
        label = trial.candidate.label
        place = None if folder is None else folder / LADDER / f"{i}-{label}"
        model = ladder.made(trial.candidate)
        try:
            score = ladder.fitted(model, trial.candidate, trial_epochs, place).validation_score
        except DivergenceError:
            score = math.inf
        trained.append(model)
        trials[i] = replace(trial, score=math.inf if math.isnan(score) else score)
        _write(folder, trials, trial_epochs)
    chosen = min(range(len(trials)), key=lambda i: trials[i].score)
    if not math.isfinite(trials[chosen].score):
        raise DivergenceError(
            "the training of every candidate diverged; lower the learning rates, or look at "
            "`offbeat inspect` for wild values in the log"
        )
    best = trials[chosen]
    model, epochs = ladder.made(best.candidate), config.epochs or best.epochs
    config = replace(config, learning_rate=best.candidate.learning_rate, epochs=epochs)
    result = ladder.fitted(model, best.candidate, epochs, folder)
    if not result.validation_score <= best.score:  # the shorter training was the better one
        model.load_state_dict(trained[chosen].state_dict())
        if folder is not None:
            save_model(model, folder / "model")
    return LadderResult(model, result, tuple(trials), trial_epochs, chosen, config)


class _Ladder:
    """What the trainings of a ladder share."""

    def __init__(
        self,
        train: Dataset,
        validation: Dataset,
        config: TrainConfig,
        scaler: ScalerKind | Scaler,
        baselines: Sequence[Baseline] | None,
        seed: int,
        device: str | None,
        progress: bool,
    ) -> None:
        self.train, self.validation, self.config = train, validation, config
        self.scaler, self.seed, self.device, self.progress = scaler, seed, device, progress
        model = make_model("gru", train, scaler=scaler, hidden_size=1)
        self.recipe = recipe_of(model.name, config, validated=True)
        self.tasks, self.others = reference_tasks(ordered(model, train), self.recipe)
        self.baselines = fitted_baselines(self.tasks) if baselines is None else tuple(baselines)

    def made(self, candidate: Candidate) -> BaseModel:
        """An untrained model."""
        found: Model = make_model(
            candidate.model, self.train, scaler=self.scaler, seed=self.seed, tasks=self.tasks
        )
        if candidate.corrects is None:
            return found
        kind = BASELINES[candidate.corrects]
        fitted = [each for each in self.baselines if type(each) is kind]
        base = fitted[0] if fitted else kind().fit(self.tasks)
        if not isinstance(base, CausalBaseline):
            raise InputError(
                f"the baseline {candidate.corrects!r} uses the future; give a causal one"
            )
        return CorrectedModel.of(found, base, self.others)

    def fitted(
        self, model: BaseModel, candidate: Candidate, epochs: int, folder: Path | None
    ) -> FitResult:
        """Trains a model in place."""
        config = replace(self.config, learning_rate=candidate.learning_rate, epochs=epochs)
        return fit(
            model,
            self.train,
            self.validation,
            config,
            out=folder,
            baselines=self.baselines,
            device=self.device,
            progress=self.progress,
        )

    def plan(
        self, candidates: Sequence[Candidate], budget_s: float | None, folder: Path | None
    ) -> tuple[list[Trial], int]:
        """The candidates within the budget, and the epochs of each trial."""
        if folder is not None and (folder / LADDER / PLAN).is_file():
            return _read(folder / LADDER / PLAN, candidates)
        if budget_s is None:
            trials = [Trial(candidate, 0.0, EPOCHS[1]) for candidate in candidates]
            return _write(folder, trials, TRIAL_EPOCHS[1])
        assert self.recipe.tasks is not None
        tasks = number_of_tasks(self.train, self.recipe.tasks, self.recipe.tasks_per_epoch)
        steps = math.ceil(tasks / self.recipe.batch_size)
        half = budget_s / 2 / (OVERHEAD * steps)
        trials, total = [], 0.0
        for candidate in candidates:
            seconds = self._seconds_per_step(candidate)
            if trials and (total + seconds) * TRIAL_EPOCHS[0] > half:
                break
            total += seconds
            trials.append(Trial(candidate, seconds, _within(half / seconds, EPOCHS)))
        return _write(folder, trials, _within(half / total, TRIAL_EPOCHS))

    def _seconds_per_step(self, candidate: Candidate) -> float:
        """Time of a training step and of the drawing of its tasks, after a first epoch."""
        tasks = _TIMED_STEPS * self.recipe.batch_size
        config = replace(self.config, tasks_per_epoch=tasks, epochs=3, checkpoint_every=None)
        ends: list[Clock] = []
        fit(
            self.made(candidate),
            self.train,
            config=config,
            baselines=self.baselines,
            callbacks=[lambda *_: ends.append(Clock())],
            progress=False,
        )
        return max((ends[2] - ends[0]) / (2 * _TIMED_STEPS), 1e-6)


def _within(number: float, limits: tuple[int, int]) -> int:
    return max(limits[0], min(limits[1], int(number)))


def _write(folder: Path | None, trials: list[Trial], trial_epochs: int) -> tuple[list[Trial], int]:
    """Keeps the plan and the results so far; returns them."""
    if folder is not None:
        (folder / LADDER).mkdir(parents=True, exist_ok=True)
        known = [
            {**asdict(t), "score": t.score if math.isfinite(t.score) else None} for t in trials
        ]
        write_json(folder / LADDER / PLAN, {"trial_epochs": trial_epochs, "trials": known})
    return trials, trial_epochs


def _read(path: Path, candidates: Sequence[Candidate]) -> tuple[list[Trial], int]:
    """The plan of a run that was stopped; its scores are computed again, from its checkpoints."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        trials = [
            Trial(
                Candidate(
                    from_mapping(ModelConfig, each["candidate"]["model"]),
                    float(each["candidate"]["learning_rate"]),
                    each["candidate"]["corrects"],
                ),
                float(each["seconds_per_step"]),
                int(each["epochs"]),
            )
            for each in record["trials"]
        ]
        epochs = int(record["trial_epochs"])
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path} is damaged ({type(error).__name__}: {error}); give another folder"
        ) from None
    if [t.candidate for t in trials] != list(candidates[: len(trials)]):
        raise InputError(
            f"{path} is the plan of a run with other candidates; give the same as then, or another "
            "folder"
        )
    return trials, epochs
