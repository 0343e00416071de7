"""How a record came about: its protocol, time and machine, and where its runs differ in these."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from offbeat import OffbeatError
from offbeat.sweeps.record import SESSIONS
from thesis.protocol import Protocol
from thesis.report import thesis_numbers as thesis
from thesis.report.records import PROVENANCE, Record
from thesis.report.tables import label, percent

_NAMES = {
    "commit": "commit",
    "bits": "bits (fingerprint of small trainings)",
    "cpu": "processor",
    "kernel_body": "scan backend",
    "threads": "threads per run",
    "torch": "torch",
    "mujoco": "mujoco",
    "data": "recorded data (hash)",
}


@dataclass(frozen=True)
class Circumstances:
    """Further files in the folder of a record.

    Attributes:
        protocol: the fields of the protocol; empty where the folder has none.
        sessions_s: s, wall time of all sessions together; None where it was not kept.
        sessions: how many there were.
        engines: what ran them, each once, that of the last session last.
        commands: what was typed.
        machine: names and values of what the record itself does not hold.
    """

    protocol: Mapping[str, Any] = field(default_factory=dict)
    sessions_s: float | None = None
    sessions: int = 0
    engines: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    machine: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, folder: str | Path) -> Circumstances:
        """Reads `protocol.json` and `sessions.json`, or `about.json` of a published record.

        Missing or damaged files are left out: the record is complete without them.
        """
        folder = Path(folder)
        about = _mapping(_json(folder / "about.json"))
        kept = [_json(folder / f"{name}.json") for name in SESSIONS]
        sessions = next(
            filter(None, map(_rows, [*kept, *(about.get(name) for name in SESSIONS)])), []
        )
        spent = [one.get("seconds") for one in sessions]
        known = [s for s in spent if isinstance(s, int | float)]
        typed = about.get("commands")
        here = _mapping(about.get("here"))
        machine: list[tuple[str, str]] = [
            (name, str(here[name])) for name in ("platform", "cores", "python") if name in here
        ]
        machine += [(k, str(v)) for k, v in _mapping(here.get("packages")).items()]
        return cls(
            _mapping(_json(folder / "protocol.json")) or _mapping(about.get("protocol")),
            float(sum(known)) if known and len(known) == len(spent) else None,
            len(sessions),
            _last_of_each(str(one["engine"]) for one in sessions if "engine" in one),
            tuple(" ".join(map(str, c)) for c in typed if isinstance(c, list))
            if isinstance(typed, list)
            else (),
            tuple(machine),
        )

    @property
    def repeats(self) -> int:
        """Of experiment 2 in the full protocol."""
        said = self.protocol.get("repeats")
        return said if isinstance(said, int) and said >= 1 else thesis.REPEATS

    @property
    def processes(self) -> int | None:
        """Number of parallel runs of the last session, if its engine records it."""
        found = re.match(r"(\d+) process", self.engines[-1]) if self.engines else None
        return int(found[1]) if found and int(found[1]) else None

    @property
    def departures(self) -> tuple[str, ...]:
        """A sentence on what the protocol has other than the thesis'; empty where nothing."""
        wanted = json.loads(json.dumps(asdict(Protocol())))
        other = [
            f"{name} {self.protocol[name]} in place of {value}"
            for name, value in wanted.items()
            if name in self.protocol and self.protocol[name] != value
        ]
        if not other:
            return ()
        return (
            "This is not the thesis' protocol, and its numbers are not to be compared with the "
            f"thesis': {'; '.join(other)}.",
        )


def _last_of_each(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(reversed(dict.fromkeys(reversed(list(names)))))


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _rows(value: Any) -> list[dict[str, Any]]:
    return [one for one in value if isinstance(one, dict)] if isinstance(value, list) else []


def wall_hours(record: Record) -> float | None:
    """Hours in which at least one run was going, pauses left out; None without times.

    Each run ended at `finished_at` and took `seconds`; what overlaps counts once. A run that was
    interrupted counts as if it had been made in one piece.
    """
    spans = []
    for seconds, ended in zip(record.runs["seconds"], record.runs["finished_at"], strict=True):
        try:
            end = datetime.fromisoformat(str(ended)).timestamp()
        except ValueError:
            return None
        spans.append((end - float(seconds), end))
    covered, reached = 0.0, -np.inf
    for start, end in sorted(spans):
        covered += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return covered / 3600


def mixing(record: Record) -> tuple[str, ...]:
    """A sentence for each circumstance in which the runs of a record differ."""
    said = []
    for column in PROVENANCE:
        counts = record.counts(column)
        if len(counts) > 1:
            parts = "; ".join(f"{value or 'not known'}: {n}" for value, n in counts.items())
            said.append(f"The runs do not share one {_NAMES[column]}. Runs by value: {parts}.")
    if len(record.counts("commit")) > 1 and len(record.counts("bits")) == 1:
        said.append("The commits differ in nothing that numbers depend on: the code is the same.")
    return tuple(said)


def broken_pairs(record: Record) -> tuple[str, ...]:
    """A sentence for each repeat whose models did not see the same test part.

    Models of a repeat share windows, masks and split, so that the last-value predictor scores the
    same for each of them, exactly. Where it does not, paired tests are invalid.
    """
    said = []
    for fraction in thesis.FRACTIONS:
        rows = record.where(experiment=2, fraction=fraction)
        repeats = record.values("repeat", rows)
        for repeat in sorted(set(repeats.tolist())):
            scores = record.values("last_value_honest_mse", rows[repeats == repeat]).astype(float)
            if np.ptp(scores) > 1e-9 * scores.max():
                models = ", ".join(
                    label(str(m)) for m in record.values("model", rows[repeats == repeat])
                )
                said.append(
                    f"At {percent(fraction)}, repeat {repeat}: the last value scores differently "
                    f"beside {models}. They were not tested on the same data, so paired tests that "
                    "contain this repeat are not valid."
                )
    return tuple(said)


@dataclass(frozen=True)
class TimeLeft:
    """What the runs that are missing would take, judged by those that are there.

    Attributes:
        runs: how many are missing.
        run_s: s, the sum of their run times: epochs times what an epoch of the model took so far.
        at_a_time: processes of the last session, or runs that went at a time so far, on average
            over the time in which any did.
        guessed: models without a finished run; an epoch of theirs is taken to cost as much as the
            mean of all others.
    """

    runs: int
    run_s: float
    at_a_time: float | None
    guessed: tuple[str, ...] = ()


def time_left(record: Record, circumstances: Circumstances) -> TimeLeft | None:
    """Estimates the time of the runs that a record lacks; None where it lacks none.

    Args:
        record: finished runs.
        circumstances: know the protocol, or it is the thesis', and what ran it.
    """
    known = {f.name for f in fields(Protocol)}
    try:
        whole = Protocol(**{name: v for name, v in circumstances.protocol.items() if name in known})
    except (OffbeatError, TypeError, ValueError):  # of another version, or damaged
        return None
    there = set(record.runs["run_id"].tolist())
    missing = [run for run in whole.runs() if run.run_id not in there]
    if not missing:
        return None
    seconds, epochs = (record.runs[name].astype(float) for name in ("seconds", "epochs"))
    usual = float(seconds.sum() / epochs.sum())
    each = {
        str(model): float(seconds[mine].sum() / epochs[mine].sum())
        for model in set(record.runs["model"].tolist())
        if (mine := record.runs["model"] == model).any()
    }
    covered = wall_hours(record)
    return TimeLeft(
        len(missing),
        sum(each.get(run.model, usual) * run.epochs for run in missing),
        circumstances.processes or (float(seconds.sum() / (3600 * covered)) if covered else None),
        tuple(dict.fromkeys(run.model for run in missing if run.model not in each)),
    )


def time_rows(record: Record, circumstances: Circumstances) -> list[tuple[str, str]]:
    """Time and its parts, as names and values; for an incomplete record, the remaining time."""
    seconds = record.runs["seconds"].astype(float)
    rows = [("Runs", f"{len(record)}"), ("Sum of the run times", hours(seconds.sum()))]
    for experiment in (1, 2):
        runs = record.where(experiment=experiment)
        if len(runs):
            rows.append(
                (f"Experiment {experiment}", f"{hours(seconds[runs].sum())}, {len(runs)} runs")
            )
    covered = wall_hours(record)
    if covered is not None:
        rows.append(("Wall time with at least one run going", hours(3600 * covered)))
    if circumstances.sessions_s is not None:
        count = circumstances.sessions
        said = f"{hours(circumstances.sessions_s)}, {count} session{'s' * (count != 1)}"
        rows.append(("Wall time of all sessions", said))
    if covered:
        rows.append(("Runs at a time, on average", f"{seconds.sum() / (3600 * covered):.1f}"))
    if circumstances.engines:
        rows.append(("Ran by", "; ".join(circumstances.engines)))
    ended = sorted(str(t) for t in record.runs["finished_at"])
    rows += [("First run finished", ended[0]), ("Last run finished", ended[-1])]
    left = time_left(record, circumstances)
    if left is not None:
        rows += _left_rows(left, float(seconds.sum()))
    return rows


def _left_rows(left: TimeLeft, spent: float) -> list[tuple[str, str]]:
    said = f"{left.runs} runs, about {hours(left.run_s)} of run time"
    total = f"about {hours(spent + left.run_s)} of run time"
    if left.at_a_time:
        pace = f"at {left.at_a_time:.2g} runs at a time"
        said += f", {hours(left.run_s / left.at_a_time)} of wall time {pace}"
        total += f", {hours((spent + left.run_s) / left.at_a_time)} of wall time {pace}"
    basis = "what an epoch of each model has taken so far"
    if left.guessed:
        named = ", ".join(map(label, left.guessed))
        basis += f"; no run yet of {named}, which are taken to cost as much as the others"
    return [
        ("Still to run (estimate)", said),
        ("The whole protocol (estimate)", total),
        ("Basis of the estimate", basis),
    ]


def machine_rows(record: Record, circumstances: Circumstances) -> list[tuple[str, str]]:
    """Machine and versions, as names and values, each with the number of runs where they differ.

    What only the folder knows comes last; it is of the machine that published the record.
    """
    rows = []
    for column, name in _NAMES.items():
        counts = record.counts(column)
        values = [
            f"{value or 'not known'}" + (f" ({n} runs)" if len(counts) > 1 else "")
            for value, n in counts.items()
        ]
        rows.append((name[0].upper() + name[1:], "; ".join(values)))
    there = {name.lower() for name, _ in rows}
    rows += [(k[0].upper() + k[1:], v) for k, v in circumstances.machine if k not in there]
    return rows


def hours(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
