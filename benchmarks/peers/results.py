"""Runs peers in processes of their own and scores them; a JSON file per log and peer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.files import write_json
from offbeat.sweeps.provenance import commit, cpu

from .problem import Problem, digest, load
from .registry import PEERS, Options
from .tasks import paths

ROOT = Path(__file__).resolve().parents[2]


def path_of(out: Path, log: str, peer: str, seed: int) -> Path:
    """The file of a pair.

    Args:
        out: folder of the results.
        log: name.
        peer: name.
        seed: of masks and weights; files of seed 0 have no number.
    """
    return out / log / f"{peer}{f'-seed{seed}' if seed else ''}.json"


def run(
    log: str,
    peer: str,
    tasks: Path,
    out: Path,
    options: Options,
    *,
    python: str = sys.executable,
    again: bool = False,
) -> dict[str, Any]:
    """Runs a peer on a log, unless its result is there.

    Args:
        log: name; its tasks were made.
        peer: name.
        tasks: folder of the tasks.
        out: folder of the results.
        options: of the peer.
        python: interpreter for peers with an environment of their own.
        again: run it although there is a result.

    Returns:
        The result, with `error` instead of scores where the peer failed.

    Raises:
        FileNotFoundError: the tasks were not made.
        ValueError: the result that is there was made of other tasks.
    """
    inputs, truth = paths(tasks, log, options.seed)
    if not inputs.exists():
        raise FileNotFoundError(f"{inputs} is not there; run `python -m benchmarks.peers tasks`")
    path, made_of = path_of(out, log, peer, options.seed), digest(inputs)
    if path.exists() and not again:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if found["tasks"] != made_of:
            raise ValueError(f"{path} was made of other tasks; move it away or give --again")
        return found
    entry = PEERS[peer]
    result: dict[str, Any] = {
        "log": log,
        "peer": peer,
        "title": entry.title,
        "seed": options.seed,
        "tasks": made_of,
        "command": f"python -m benchmarks.peers run --log {log} --peer {peer} "
        f"--seed {options.seed} --budget_s {options.budget_s:g}",
        "lines": entry.lines(),
        "commit": commit(),
        "cpu": cpu(),
    }
    with tempfile.TemporaryDirectory() as folder:
        answered = _work(peer, inputs, Path(folder), options, python)
        if answered:
            result["error"] = answered
        else:
            result |= json.loads((Path(folder) / "cost.json").read_text(encoding="utf-8"))
            with np.load(Path(folder) / "answers.npz", allow_pickle=False) as file:
                answers = {name: file[name] for name in file.files}
            try:
                result["scores"] = score(load(inputs), truth, answers)
            except ValueError as error:
                result["error"] = str(error)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return result


def _work(peer: str, inputs: Path, out: Path, options: Options, python: str) -> str:
    """Runs the worker; returns the last line of its error, or an empty text."""
    # The worker has a folder of its own; the link of an environment's interpreter is not followed.
    place = os.path.abspath(python) if os.path.dirname(python) else python
    command = [
        place if PEERS[peer].elsewhere else sys.executable,
        *("-m", "benchmarks.peers", "answer", "--peer", peer, "--inputs", str(inputs.resolve())),
        *("--out", str(out), "--seed", str(options.seed), "--budget_s", str(options.budget_s)),
    ]
    if options.checkout is not None:
        command += ["--pyomnits", str(options.checkout)]
    places = [str(ROOT), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    environment = os.environ | threads | {"PYTHONPATH": os.pathsep.join(filter(None, places))}
    done = subprocess.run(command, env=environment, cwd=out, capture_output=True, text=True)
    if done.returncode == 0:
        return ""
    print(done.stderr[-2000:], file=sys.stderr)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"ended with code {done.returncode}"


def score(
    problem: Problem, truth: Path, answers: Mapping[str, np.ndarray[Any, Any]]
) -> dict[str, Any]:
    """Scores answers on the hidden values.

    Args:
        problem: of the answers.
        truth: file of the hidden values.
        answers: by task, as of `worker.answers`.

    Returns:
        By task `rmse_scaled`, `rmse` per channel in units (None without values), `values`, their
        number, and with intervals `coverage_90` and `width_90_scaled`.

    Raises:
        ValueError: an answer is missing, or an interval is not finite.
    """
    found: dict[str, Any] = {}
    with np.load(truth, allow_pickle=False) as file:
        hidden = {name: file[name] for name in file.files}
    for task in problem.asked:
        if task not in answers:
            continue
        known = np.isfinite(hidden[task])
        error = np.where(known, answers[task] - hidden[task], 0.0)
        if not np.isfinite(error).all():
            raise ValueError(f"{task}: {(~np.isfinite(error)).sum()} answers are missing")
        counts = known.sum(axis=0)
        sums = (error**2).sum(axis=0)
        each = np.sqrt(sums / np.maximum(counts, 1))
        scores: dict[str, Any] = {
            "rmse_scaled": float(np.sqrt((sums / problem.scale**2).sum() / counts.sum())),
            "rmse": [float(f"{e:.6g}") if n else None for e, n in zip(each, counts, strict=True)],
            "values": int(counts.sum()),
        }
        if f"{task}|low" in answers:
            low, high = answers[f"{task}|low"], answers[f"{task}|high"]
            if not np.isfinite((high - low)[known]).all():
                raise ValueError(f"{task}: some intervals are not finite")
            inside = (low <= hidden[task]) & (hidden[task] <= high)
            scores["coverage_90"] = float(inside[known].mean())
            scores["width_90_scaled"] = float(((high - low) / problem.scale)[known].mean())
        found[task] = scores
    return found
