"""Results on disk: a JSON file per log and seed, and what several of them say together."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError
from offbeat.files import write_json
from offbeat.metrics import null_if_nan
from offbeat.sweeps.provenance import commit

from . import scores
from .figures import draw
from .logs import ROOT, Log
from .predictors import PREDICTORS

Array = NDArray[np.float64]


def path_of(out: Path, log: str, seed: int, quick: bool) -> Path:
    """The file of a log and a seed."""
    return out / log / f"{'quick_' if quick else ''}seed{seed}.json"


def files_of(out: Path, log: str, quick: bool) -> list[Path]:
    """The files of a log, in the order of their seeds."""
    start = path_of(out, log, 0, quick).name.removesuffix("0.json")
    found = out.joinpath(log).glob(f"{start}*.json")
    return sorted(found, key=lambda path: int(path.stem.removeprefix(start)))


def run(
    log: Log,
    out: Path,
    seed: int,
    *,
    names: Iterable[str],
    quick: bool = False,
    again: bool = False,
    figures: Path | None = None,
) -> Path:
    """Fits and scores predictors, and adds them to the file of a log and a seed.

    Args:
        log: what is asked.
        out: folder of the results.
        seed: of the fits.
        names: of `PREDICTORS`; those in the file are left out, and for seeds after the first, those
            that do not depend on it.
        quick: whether the log is a small part.
        again: run also those in the file.
        figures: folder of a figure of the models that are fitted with seed 0.

    Returns:
        The file.

    Raises:
        InputError: the file has other tasks or another scale.
    """
    path = path_of(out, log.name, seed, quick)
    found = head = described(log, seed)
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        if any(found[key] != head[key] for key in ("channels", "scale", "counts")):
            if not again:
                raise InputError(f"{path} has scores of other tasks; move it away or give --again")
            found = head
    for name in names:
        entry = PREDICTORS[name]
        if (entry.once and seed) or (not again and set(entry.names) <= set(found["predictors"])):
            continue
        started = time.perf_counter()
        fitted = entry.make(log, seed, quick)
        fit_s = time.perf_counter() - started
        for each, predictor in fitted.items():
            started = time.perf_counter()
            result = {
                test: {
                    task.name: _plain(scores.score(task, predictor, log.scale))
                    for task in asked
                    if predictor.causal or task.two_sided
                }
                for test, asked in log.asked.items()
            }
            found["predictors"][each] = {
                "causal": predictor.causal,
                "fit_s": round(fit_s, 2),
                "predict_s": round(time.perf_counter() - started, 2),
                "commit": commit(),
                "scores": result,
            }
            print(f"{log.name}, seed {seed}: {each}, fitted in {fit_s:.1f} s", flush=True)
        write_json(path, found)
        if figures and not seed and not entry.once and len(fitted) > 1:
            draw(log, fitted, figures / f"real_{log.name}.png")
    return path


def described(log: Log, seed: int) -> dict[str, Any]:
    """The head of a file of results.

    Args:
        log: what is asked.
        seed: of the fits.
    """
    return {
        "log": log.name,
        "title": log.title,
        "seed": seed,
        "command": " ".join(["python -m examples.real_logs", *_options(sys.argv[1:])]),
        "machine": machine(),
        "rows": {
            "train": sum(t.rows for t in log.train),
            "validation": sum(t.rows for t in log.validation),
            **{test: sum(t.rows for t in part) for test, part in log.tests.items()},
        },
        "channels": list(log.train.names),
        "scale": log.scale.tolist(),
        "groups": {group: list(names) for group, names in log.groups.items()},
        "counts": {
            test: {task.name: scores.counts(task) for task in asked}
            for test, asked in log.asked.items()
        },
        "predictors": {},
    }


def _options(given: Sequence[str]) -> list[str]:
    """Options of a command without the places it writes to, which change no number."""
    places = ("--out", "--document", "--readme", "--figures")
    kept: list[str] = []
    words = iter(given)
    for word in words:
        if word in places:
            next(words, None)
        elif word.partition("=")[0] not in places:
            kept.append(word)
    return kept


def machine() -> dict[str, Any]:
    """Where and with what this ran, as the benchmarks say it."""
    if str(ROOT / "benchmarks") not in sys.path:
        sys.path.append(str(ROOT / "benchmarks"))
    from common import machine as described_machine

    found: dict[str, Any] = described_machine()
    return found


def _plain(found: Mapping[str, Any]) -> dict[str, Any]:
    """JSON-like form, numbers with eight digits."""
    rmse = [null_if_nan(float(f"{value:.8g}")) for value in found["rmse"]]
    return {**found, "rmse": rmse}


@dataclass(frozen=True)
class Intervals:
    """Scores of intervals, means over seeds; keys are as in the files.

    Attributes:
        coverage: by level.
        score: interval score by level, scaled.
        widths: of intervals of 90 % by the longest time since observation in s, scaled.
        crps: scaled.
    """

    coverage: dict[str, float]
    score: dict[str, float]
    widths: dict[str, float]
    crps: float


def _means(each: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([one[key] for one in each])) for key in (each[0] if each else {})}


class Summary:
    """The results of a log, over its seeds.

    Args:
        files: of `run`, one per seed, in the order of the seeds.
    """

    def __init__(self, files: Iterable[Path]) -> None:
        found = [json.loads(path.read_text(encoding="utf-8")) for path in files]
        self.head = found[0]
        self.seeds = [each["seed"] for each in found]
        self.tests: list[str] = list(self.head["counts"])
        self.predictors: dict[str, list[dict[str, Any]]] = {}
        known = [name for entry in PREDICTORS.values() for name in entry.names]
        for name in known:
            runs = [each["predictors"][name] for each in found if name in each["predictors"]]
            if runs:
                self.predictors[name] = runs

    def causal(self, name: str) -> bool:
        """Whether a predictor uses the past only."""
        return bool(self.predictors[name][0]["causal"])

    def tasks(self, test: str) -> list[str]:
        """Names of the tasks of a test part."""
        return list(self.head["counts"][test])

    def counts(self, test: str, task: str) -> NDArray[np.int64]:
        """(channels,) scored values."""
        return np.array(self.head["counts"][test][task])

    def _of(self, test: str, task: str, name: str, key: str) -> list[Any]:
        runs = [run["scores"][test] for run in self.predictors[name]]
        return [run[task][key] for run in runs if key in run.get(task, {})]

    def rmse(self, test: str, task: str, name: str) -> Array | None:
        """(channels,) in units, the root of the mean square over seeds; None if not asked."""
        each = self._of(test, task, name, "rmse")
        if not each:
            return None
        return np.asarray(np.sqrt(np.mean(np.square(np.array(each, dtype=np.float64)), axis=0)))

    def scaled(self, test: str, task: str, name: str) -> list[float]:
        """RMSE over all channels in scaled units, per seed; empty if not asked."""
        return self._of(test, task, name, "rmse_scaled")

    def intervals(self, test: str, task: str, name: str) -> Intervals | None:
        """Scores of the intervals of a predictor, means over seeds; None without them."""
        coverage = self._of(test, task, name, "coverage")
        if not coverage:
            return None
        score, widths = (
            self._of(test, task, name, key) for key in ("interval_score_scaled", "widths_scaled")
        )
        crps = float(np.mean(self._of(test, task, name, "crps_scaled")))
        return Intervals(_means(coverage), _means(score), _means(widths), crps)

    def grouped(self, test: str, task: str, name: str) -> dict[str, float]:
        """RMSE over the values of each group of channels, in their unit; NaN without values."""
        rmse, n = self.rmse(test, task, name), self.counts(test, task)
        assert rmse is not None
        result = {}
        for group, names in self.head["groups"].items():
            at = [self.head["channels"].index(channel) for channel in names]
            total = n[at].sum()
            squares = np.nansum(rmse[at] ** 2 * n[at])
            result[group] = float(np.sqrt(squares / total)) if total else float("nan")
        return result

    def ratios(self, test: str, task: str, name: str, others: Iterable[str]) -> Array:
        """Ratios of the error of a predictor to the best of others, per scored channel.

        Args:
            test: name of a test part.
            task: name of a task.
            name: of the predictor.
            others: names.

        Returns:
            (scored channels,); empty where the predictor or all others are not asked the task.
        """
        errors = {}
        for each in {name, *others} & set(self.predictors):
            rmse = self.rmse(test, task, each)
            if rmse is not None:
                errors[each] = rmse / np.array(self.head["scale"])
        return scores.ratios(errors, name, others) if name in errors else np.empty(0)
