"""The parts of an experiment to commit: the record, its provenance, and eight small models."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from offbeat.data.simulate import available_cores
from offbeat.files import atomic_folder, write_json
from offbeat.sweeps.record import SESSIONS
from offbeat.sweeps.session import read_sessions
from offbeat.sweeps.task import TRAINING
from thesis.protocol import Protocol
from thesis.record import GROUP, Record
from thesis.reproduce import provenance_here

ABOUT = "about.json"
_PACKAGES = ("torch", "numpy", "scipy", "mujoco", "dm_control", "pyarrow")
_KEPT = ("ode_rnn", "ode_gru_d")
"""Models whose weights of experiment 1 are kept."""


def publish(
    out: str | Path, to: str | Path, protocol: Protocol, *, command: Sequence[str] = ()
) -> None:
    """Copies the record of an experiment, with all that belongs to it, to a folder to commit.

    Existing files are extended, never removed: the sessions and models of another machine
    stay.

    Args:
        out: folder of the experiment.
        to: folder to write: record and curves, `about.json` (protocol, sessions with their wall
            time, machine, versions, command, and how many runs were made by what), and under
            `models/` the weights of ODE-RNN and ODE-GRU-D in experiment 1.
        protocol: of the experiment.
        command: what was typed; it is kept without its time limit.
    """
    out, to = Path(out), Path(to)
    record = Record.read(out)
    record = record.merged(Record.read(to)).in_order(run.run_id for run in protocol.runs())
    record.write(to)
    for run in protocol.runs():
        model = out / "runs" / run.run_id / TRAINING / "model"
        if run.experiment == 1 and run.model in _KEPT and model.is_dir():
            with atomic_folder(to / "models" / run.run_id) as temporary:
                shutil.copytree(model, temporary, dirs_exist_ok=True)
    write_json(to / ABOUT, _about(out, to, record, protocol, command))


def _about(
    out: Path, to: Path, record: Record, protocol: Protocol, command: Sequence[str]
) -> dict[str, Any]:
    try:
        before = json.loads((to / ABOUT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = {}
    lines = [line for name in SESSIONS for line in before.get(name, [])] + read_sessions(out)
    # Two short ones may start within one second.
    sessions = {(line["began_at"], line["seconds"]): line for line in lines}
    ordered = [sessions[began] for began in sorted(sessions)]
    typed = [*before.get("commands", []), list(command)]
    commands = [line for line in map(_without_budget, typed) if line]
    return {
        "commands": [line for i, line in enumerate(commands) if line not in commands[:i]],
        "runs_done": len(record.runs),
        "runs_total": len(protocol.runs()),
        "seconds_of_runs": sum(row["seconds"] for row in record.runs.values()),
        "seconds_of_sessions": sum(line["seconds"] for line in ordered),
        "made_by": [
            {**dict(zip(GROUP, group, strict=True)), "runs": count}
            for group, count in record.groups().items()
        ],
        "here": {
            **provenance_here(),
            "cores": available_cores(),
            "platform": platform.platform(),
            "python": platform.python_version(),
            "packages": {name: _version(name) for name in _PACKAGES},
        },
        "sessions": ordered,
        "protocol": asdict(protocol),
    }


def _without_budget(command: Sequence[str]) -> list[str]:
    """A command without its time limit, which does not affect the results."""
    kept, value = list[str](), False
    for word in command:
        option = word.partition("=")[0] == "--budget_minutes"
        if not option and not value:
            kept.append(word)
        value = option and "=" not in word
    return kept


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
