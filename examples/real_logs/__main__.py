"""Runs and reports: python -m examples.real_logs --help."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from examples.documents import between

from . import report
from .figures import draw_calibration
from .logs import LOGS, MissingLogError
from .predictors import PREDICTORS
from .results import Summary, files_of, run


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the predictors that are not in the results yet, prints the tables, fills the document.

    Args:
        arguments: of the command line.
    """
    parser = argparse.ArgumentParser(prog="python -m examples.real_logs", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/real_logs"))
    parser.add_argument("--seeds", type=int, default=1, help="how many, from 0 on, to run")
    parser.add_argument("--log", action="append", choices=LOGS, help="by default all; repeat it")
    parser.add_argument(
        "--predictor", action="append", choices=PREDICTORS, help="by default all; repeat it"
    )
    parser.add_argument("--again", action="store_true", help="also what is in the results already")
    parser.add_argument("--quick", action="store_true", help="a small part, for tests")
    parser.add_argument("--document", type=Path, help="Markdown file whose tables are written")
    parser.add_argument("--readme", type=Path, help="Markdown file whose first table is written")
    parser.add_argument("--figures", type=Path, help="folder of figures; without it, none is drawn")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    missing, front = [], []
    for name in options.log or LOGS:
        try:
            log = LOGS[name](options.quick)
        except MissingLogError as error:
            missing.append(f"{name}: {error}")
            continue
        for seed in range(options.seeds):
            run(
                log,
                options.out,
                seed,
                names=options.predictor or PREDICTORS,
                quick=options.quick,
                again=options.again,
                figures=options.figures,
            )
        files = files_of(options.out, name, options.quick)
        summary = Summary(files)
        body = report.tables(summary)
        if "offbeat" in summary.predictors and len(summary.tasks(summary.tests[0])) > 1:
            front.append(summary)
        if options.figures:
            draw_calibration(summary, summary.tests[0], options.figures / f"calibration_{name}.png")
        print(f"\n{log.title}\n\n{body}\n")
        every = f"# {log.title}\n\n{report.tables(summary, every=True)}\n"
        (files[0].parent / f"{'quick_' if options.quick else ''}tables.md").write_text(every)
        if options.document:
            text = options.document.read_text(encoding="utf-8")
            options.document.write_text(between(text, name, body), encoding="utf-8")
    if options.readme and front:
        text = options.readme.read_text(encoding="utf-8")
        page = between(text, "real logs", report.front_page(front))
        options.readme.write_text(page, encoding="utf-8")
    if missing:
        raise SystemExit("\n".join(missing))


if __name__ == "__main__":
    main()
