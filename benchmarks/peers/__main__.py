"""Makes tasks, runs peers on them and writes their table: python -m benchmarks.peers --help."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .registry import PEERS, Options
from .table import LOGS as LOG_NAMES


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command.

    Args:
        arguments: of the command line.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    tasks = commands.add_parser("tasks", help="write what is hidden and asked, once")
    run = commands.add_parser("run", help="run the pairs of log and peer that have no result yet")
    table = commands.add_parser("table", help="write the results into the documents")
    answer = commands.add_parser("answer", help="one peer, in this process; `run` calls it")
    for each in (tasks, run):
        each.add_argument("--log", action="append", choices=LOG_NAMES, help="by default all")
        each.add_argument("--tasks", type=Path, default=Path(".cache/peers"), help="their folder")
    for each in (run, table):
        each.add_argument("--out", type=Path, default=Path("results/peers"))
    for each in (tasks, run, answer):
        each.add_argument("--seed", type=int, default=0, help="of masks and weights")
    for each in (run, answer):
        each.add_argument("--budget_s", type=float, default=Options.budget_s, help="of a training")
        each.add_argument("--pyomnits", type=Path, help="folder of a checkout of PyOmniTS")
    run.add_argument("--peer", action="append", choices=PEERS, help="by default all")
    run.add_argument("--python", default=sys.executable, help="interpreter of the peers")
    run.add_argument("--again", action="store_true", help="also pairs that have a result")
    tasks.add_argument("--quick", action="store_true", help="a small part, for tests")
    answer.add_argument("--peer", choices=PEERS, required=True)
    answer.add_argument("--inputs", type=Path, required=True)
    answer.add_argument("--out", type=Path, required=True)
    table.add_argument("--document", type=Path, action="append", help="by default both pages")
    given = parser.parse_args(arguments)
    globals()[f"_{given.command}"](given)


def _tasks(given: argparse.Namespace) -> None:
    from examples.real_logs.logs import MissingLogError

    from .tasks import make

    for log in given.log or LOG_NAMES:
        try:
            inputs, _ = make(log, given.tasks, seed=given.seed, quick=given.quick)
        except MissingLogError as error:
            print(f"{log}: {error}", file=sys.stderr)
        else:
            print(f"{log}: {inputs}")


def _run(given: argparse.Namespace) -> None:
    from . import results

    options = _options(given)
    for log in given.log or LOG_NAMES:
        for peer in given.peer or PEERS:
            if peer.startswith("pyomnits") and given.pyomnits is None:
                continue
            found = results.run(
                log, peer, given.tasks, given.out, options, python=given.python, again=given.again
            )
            said = found.get("error") or ", ".join(
                f"{task} {scores['rmse_scaled']:.3g}" for task, scores in found["scores"].items()
            )
            print(f"{log}, {peer}: {said}", flush=True)


def _answer(given: argparse.Namespace) -> None:
    from .worker import work

    work(given.peer, given.inputs.resolve(), given.out, _options(given))


def _table(given: argparse.Namespace) -> None:
    from .table import DOCUMENTS, fill_in

    for page in given.document or DOCUMENTS:
        page.write_text(fill_in(page.read_text(encoding="utf-8"), given.out), encoding="utf-8")


def _options(given: argparse.Namespace) -> Options:
    checkout = given.pyomnits.resolve() if given.pyomnits else None
    return Options(given.budget_s, given.seed, checkout)


if __name__ == "__main__":
    main()
