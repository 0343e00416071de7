"""Runs all runs of a plan; an interrupted call can be repeated to resume."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.data.store import save
from offbeat.data.trajectory import Dataset
from offbeat.devices import resolved
from offbeat.errors import InputError, one_of
from offbeat.files import clean, writable, write_json
from offbeat.sweeps.engines import engine_named
from offbeat.sweeps.plan import Plan, Run
from offbeat.sweeps.progress import Progress, duration
from offbeat.sweeps.record import Group, Record, Row
from offbeat.sweeps.session import Session
from offbeat.sweeps.task import SCORES, Task
from offbeat.sweeps.together import TogetherEngine, default_together

if TYPE_CHECKING:
    from offbeat.comparison import Comparison

MIXED = ("refuse", "accept", "redo")


@dataclass(frozen=True)
class SweepResult:
    """Result of a call of `sweep`.

    Attributes:
        folder: holds `record.parquet`, `record.csv`, `curves.parquet`, `curves.csv`, `runs/`.
        record: all runs that are finished, those of earlier calls too.
        asked: requested runs.
        seconds: wall time of this call.
    """

    folder: Path
    record: Record
    asked: tuple[Run, ...]
    seconds: float

    @property
    def missing(self) -> tuple[Run, ...]:
        """Requested runs that are not finished."""
        return tuple(run for run in self.asked if run.run_id not in self.record.runs)

    def __str__(self) -> str:
        done = len(self.asked) - len(self.missing)
        spent = sum(row["seconds"] for row in self.record.runs.values())
        text = (
            f"{self.folder}: {done} of {len(self.asked)} runs are in the record, which took "
            f"{duration(spent)} of processes in all; this call: {duration(self.seconds)}"
        )
        return text if not self.missing else f"{text}. The same call resumes"

    def compare(self, **options: Any) -> Comparison:
        """Compares the models over the repeats.

        Args:
            **options: of `offbeat.compare`.

        Raises:
            InputError: as `offbeat.compare`: fewer than three repeats are finished, for instance.
        """
        from offbeat.comparison import compare

        return compare(self.folder, **options)


def run_plan(
    plan: Plan,
    out: str | Path,
    dataset: Dataset | None = None,
    *,
    engine: str = "local",
    asked: Sequence[Run] | None = None,
    record: str | Path | None = None,
    mixed: str = "refuse",
    processes: int | None = None,
    threads: int = 1,
    device: str = "cpu",
    together: int | None = None,
    budget_minutes: float | None = None,
    engine_options: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> SweepResult:
    """Performs the runs of a plan that are not finished, and keeps a record of them.

    It can be killed at any moment: the same call resumes and gives the same numbers.

    Args:
        plan: the runs and their settings.
        out: folder for data, runs and the record.
        dataset: the trajectories; by default those that the plan simulates.
        engine: `local`, `ray` or `slurm`; all give the same numbers. The workers of a cluster
            must see `out` under the same path.
        asked: runs to do; by default all of them.
        record: folder of another record; runs in it are not repeated.
        mixed: what to do where the record holds runs made by other code, on another processor,
            with another scan backend, torch or data: `refuse` to continue, `accept` them,
        marked as they are, or `redo` them.
        processes: runs at a time; by default as many as there is room for.
        threads: of each run.
        device: that models are trained on: `cpu`, `cuda` or `cuda:1`; `auto`, of the local engine,
            takes a GPU where there is one.
        together: runs of equal shape that are trained in one process, whose steps are one launch
            (`offbeat.sweeps.together`); by default 32 on a GPU with the triton backend, else 1.
        budget_minutes: stop after this time, in the middle of runs; the next call resumes them.
        engine_options: of Ray or Slurm.
        progress: show how far it is on standard error.

    Raises:
        InputError: an argument is wrong, `out` belongs to another plan or is in use, or runs
            would be mixed.
        DivergenceError: a training diverged; all other runs are finished.
        OffbeatError: a run failed otherwise, or lost its process three times.
    """
    started = time.monotonic()
    one_of("value of mixed", mixed, MIXED)
    if budget_minutes is not None and not budget_minutes >= 0:
        raise InputError(f"budget_minutes must be at least 0, got {budget_minutes}")
    if engine == "local":  # other machines have other devices
        device = device if device == "cpu" else str(resolved(device))
    elif device == "auto":
        raise InputError(
            f"device 'auto' is that of this machine, and the engine {engine!r} runs on others; "
            "give cpu or cuda"
        )
    together = default_together(device) if together is None else together
    if not isinstance(together, int) or together < 1:
        raise InputError(f"together must be an integer of at least 1, got {together!r}")
    out = writable(out, folder=True)
    asked = plan.runs() if asked is None else tuple(asked)
    out.mkdir(parents=True, exist_ok=True)
    with _alone(out):
        _same_plan(out, plan)
        recorded, fingerprint = _data(out, plan, dataset, progress)
        tasks = {
            run.run_id: Task(
                run, plan, recorded, fingerprint, out / "runs" / run.run_id, threads, device
            )
            for run in plan.runs()
        }
        here = plan.record.group_of(
            {**plan.provenance(), "data": fingerprint[:12], "device": device}
        )
        shown = Progress(out / "status.json", show=progress)
        kept = _known(out, record, tasks, plan)
        kept = _unmixed(kept, mixed, tasks, here, shown)
        kept.in_order(tasks).write(out)
        waiting = [tasks[run.run_id] for run in asked if run.run_id not in kept.runs]
        if waiting and budget_minutes != 0:
            runner = engine_named(
                engine,
                processes=processes,
                threads=threads,
                options=engine_options,
                folder=out / engine,
            )
            if together > 1:
                runner = TogetherEngine(runner, together)
            shown.say(f"{len(asked) - len(waiting)}/{len(asked)} runs done; {runner.description}")
            deadline = None if budget_minutes is None else started + 60 * budget_minutes
            session = Session(out, runner, shown, kept, tuple(tasks), here)
            kept = session.run(waiting, asked=asked, deadline=deadline)
    return SweepResult(out, kept, asked, time.monotonic() - started)


# --- the folder -----------------------------------------------------------------------------------


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Locks the folder for this process."""
    with (out / ".lock").open("w") as file:
        if os.name == "posix":
            import fcntl

            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise InputError(
                    f"another process uses {out} (see {out / 'status.json'}); wait until it ends, "
                    "or give another folder"
                ) from None
        clean(out)
        yield


def _same_plan(out: Path, plan: Plan) -> None:
    """Saves the settings, or compares them with those that the folder was created with."""
    path = out / plan.file
    now = json.loads(json.dumps({**plan.settings(), **plan.models()}))
    try:
        then = dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        write_json(path, now)
        return
    except (ValueError, TypeError):
        then = {}
    known = plan.settings().keys() | (plan.models().keys() & then.keys())
    changed = [
        f"{k} ({then.get(k)!r} then, {v!r} now)"
        for k, v in now.items()
        if k in known and then.get(k) != v
    ]
    if changed:
        raise InputError(
            f"{out} holds another {plan.noun}: {', '.join(changed)}; give the same, or another "
            "folder"
        )
    write_json(path, {**then, **now})


def _data(out: Path, plan: Plan, dataset: Dataset | None, progress: bool) -> tuple[Path, str]:
    """The trajectories, written once, and the fingerprint of their content."""
    path, about = out / "data" / "recorded.parquet", out / "data" / "recorded.json"
    given = None if dataset is None else plan.fingerprint(dataset)
    if path.is_file():
        try:
            kept = str(json.loads(about.read_text(encoding="utf-8"))["fingerprint"])
        except (OSError, ValueError, KeyError, TypeError):
            path.unlink()  # an unfinished file
        else:
            if given not in (None, kept):
                raise InputError(
                    f"{out} holds a {plan.noun} of other trajectories (fingerprint {kept[:12]} "
                    f"then, {str(given)[:12]} now); give the same data, or another folder"
                )
            return path, kept
    recorded = plan.simulate(progress=progress) if dataset is None else dataset
    fingerprint = given or plan.fingerprint(recorded)
    about.unlink(missing_ok=True)
    save(recorded, path)
    write_json(about, {"fingerprint": fingerprint, **recorded.meta})
    return path, fingerprint


def _known(out: Path, record: str | Path | None, tasks: Mapping[str, Task], plan: Plan) -> Record:
    """All finished runs: the folder's record, finished runs that it lacks, the other record."""
    kept = plan.record.read(out)
    for name, task in tasks.items():
        row = None if name in kept.runs else task.result()
        if row is not None:
            kept = kept.with_run(row, task.curve())
    if record is not None:
        other = plan.record.read(record)
        if not other.runs:
            raise InputError(f"{record} holds no record; give the folder of record.parquet")
        kept = kept.merged(other)
    for name, row in kept.runs.items():
        _check_row(name, row, tasks, plan)
    return kept


def _check_row(name: str, row: Row, tasks: Mapping[str, Task], plan: Plan) -> None:
    """A row must be of a run of this plan: other plans may have runs of the same names."""
    if name not in tasks:
        if plan.grows:
            return
        raise InputError(f"the record holds {name!r}, which is not a run of this {plan.noun}")
    run, steps = tasks[name].run, plan.steps(tasks[name].run)
    expected = {**asdict(run), "run_id": name}  # type: ignore[call-overload]
    if steps is not None:
        expected["steps"] = steps
    wrong = [f"{k} {row[k]!r}, expected {v!r}" for k, v in expected.items() if row[k] != v]
    if wrong:
        raise InputError(
            f"the record holds {name!r} of another {plan.noun} ({'; '.join(wrong)}); give a record "
            "of this one"
        )


def _unmixed(
    kept: Record, mixed: str, tasks: Mapping[str, Task], here: Group, shown: Progress
) -> Record:
    """Checks the provenance of the runs; warns where it differs from that of this process."""
    others = {group: count for group, count in kept.groups().items() if group != here}
    if not others:
        return kept
    lines = [
        f"{count} run{'s' * (count > 1)} with {kept.group_text(group, here)}"
        for group, count in others.items()
    ]
    made = f"{'; '.join(lines)} (here: {kept.group_text(here)})"
    if mixed == "refuse":
        raise InputError(
            f"the record has runs of another provenance than this process: {made}; give "
            "mixed=accept to keep them, marked as they are, mixed=redo to repeat them, or "
            "another folder"
        )
    gone = [name for name, row in kept.runs.items() if kept.group_of(row) in others]
    if mixed == "accept":
        shown.say(f"warning: the record is mixed, {made}; its columns mark them")
        return kept
    shown.say(f"warning: these are repeated: {made}")
    for name in gone:
        (tasks[name].folder / SCORES).unlink(missing_ok=True)
    return kept.without(gone)
