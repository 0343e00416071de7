"""`python -m thesis run`."""

from __future__ import annotations

import sys
from pathlib import Path

from offbeat.cli.common import say


def run_command(
    out: Path = Path("runs/thesis"),
    tiny: bool = False,
    engine: str = "local",
    only: str | None = None,
    record: Path | None = None,
    mixed: str = "refuse",
    processes: int | None = None,
    threads: int = 1,
    budget_minutes: float | None = None,
    engine_options: dict[str, str | int | float | bool | None] | None = None,
    publish: Path | None = None,
    json: bool = False,
) -> None:
    """Repeat the thesis: 376 runs, 176 as the thesis made them and 200 that show what they mean.

    Killed at any moment, the same command continues and ends with the same numbers.

    Args:
        out: folder for data, runs and the record: record.parquet, record.csv, curves.parquet,
            curves.csv, status.json.
        tiny: all of it, small, in minutes; the numbers mean nothing.
        engine: local (processes of this machine), ray or slurm. The workers of a cluster must see
            out under the same path.
        only: a part of the runs: --only experiment=1,model=ode_rnn,model=ode_gru_d; keys are
            experiment, model, fraction and repeat.
        record: folder of another record; runs in it are not done again.
        mixed: where the record holds runs of other code, of another processor, scan backend, torch
            or data: refuse to continue, accept them (the record marks them), or redo them.
        processes: runs at a time; by default what there is room for.
        threads: of each run.
        budget_minutes: stop after so long; the same command continues later.
        engine_options: as JSON; for ray, arguments of ray.init, for slurm of submitit's
            update_parameters.
        publish: folder to copy the record to when this call ends, for a commit: record, curves,
            about.json (machine, versions, wall time of each session) and the eight models of
            ODE-RNN and ODE-GRU-D in experiment 1.
        json: print what was done as JSON.
    """
    from offbeat.files import writable
    from thesis.protocol import Protocol
    from thesis.publish import publish as publish_record
    from thesis.reproduce import reproduce

    protocol = Protocol.tiny() if tiny else Protocol()
    if publish is not None:
        writable(publish, folder=True)
    done = reproduce(
        protocol,
        out,
        engine=engine,
        only=only,
        record=record,
        mixed=mixed,
        processes=processes,
        threads=threads,
        budget_minutes=budget_minutes,
        engine_options=engine_options,
    )
    if publish is not None:
        publish_record(out, publish, protocol, command=["python", "-m", "thesis", *sys.argv[1:]])
    result = {
        "folder": str(done.folder),
        "runs_asked": len(done.asked),
        "runs_missing": [run.run_id for run in done.missing],
        "seconds": done.seconds,
    }
    say(result, str(done), json)
