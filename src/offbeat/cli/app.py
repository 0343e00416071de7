"""The command `offbeat`: each subcommand is a function, its options are the function's arguments.

Torch and everything else that is slow to import is imported inside the functions, so that
`offbeat --help` answers at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from offbeat.cli.compare import compare_command
from offbeat.cli.demo import demo_command
from offbeat.cli.doctor import doctor_command
from offbeat.cli.evaluate import evaluate_command
from offbeat.cli.export import export_command
from offbeat.cli.forecast import forecast_command
from offbeat.cli.impute import impute_command
from offbeat.cli.inspect import inspect_command
from offbeat.cli.predict import predict_command
from offbeat.cli.simulate import simulate_command
from offbeat.cli.stream import stream_command
from offbeat.cli.train import train_command
from offbeat.errors import OffbeatError

DESCRIPTION = """Learn robot motion from trajectories sampled at uneven times.

A first way through, from simulation to a scored model:

  offbeat simulate hopper.parquet --n_trajectories 2000
  offbeat train hopper.parquet runs/ode_rnn --split.window 100 --split.observed_fraction 0.3 \\
      --model.name ode_rnn --training.epochs 5
  offbeat evaluate runs/ode_rnn hopper.parquet
  offbeat predict runs/ode_rnn hopper.parquet predictions.csv
  offbeat impute runs/ode_rnn hopper.parquet filled.csv
  offbeat forecast runs/ode_rnn hopper.parquet ahead.csv --horizons '[0.05, 0.1]'

Or all of it at once, every model beside the trivial predictor: offbeat demo"""


# The functions are not named after the commands: jsonargparse would find their namesakes in the
# lazy package `offbeat`, and import torch to look at them.
COMMANDS: dict[str, Any] = {
    "simulate": simulate_command,
    "inspect": inspect_command,
    "train": train_command,
    "evaluate": evaluate_command,
    "predict": predict_command,
    "compare": compare_command,
    "stream": stream_command,
    "export": export_command,
    "impute": impute_command,
    "forecast": forecast_command,
    "demo": demo_command,
    "doctor": doctor_command,
}

# Commands that take any number of paths, as a shell hands them over.
MANY_PATHS = ("compare",)


FLAGS = ("--json", "--stats", "--tiny")
"""Options that need no value."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; returns its exit code.

    0 is success, 2 bad input (one line on standard error says what is wrong), 1 a computation that
    failed, 130 an interrupt.
    """
    return run_commands(COMMANDS, argv, prog="offbeat", description=DESCRIPTION)


def run_commands(
    commands: dict[str, Any], argv: Sequence[str] | None, *, prog: str, description: str
) -> int:
    """Runs one of several commands, each a function; returns its exit code, as `main`.

    Args:
        commands: by name.
        argv: what was typed after the program's name.
        prog: the program's name.
        description: for its help.
    """
    from jsonargparse import ArgumentError, auto_cli, set_parsing_settings

    # No value, from a file or typed, may name a class or a function that is then called.
    set_parsing_settings(instantiate_subclass_spec_in_any=False, import_path_denylist=["*"])
    arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    # Flags, although options made from bool arguments want a value.
    arguments = [f"{argument}=true" if argument in FLAGS else argument for argument in arguments]
    if arguments == ["--version"]:
        from offbeat import __version__

        print(f"offbeat {__version__}")
        return 0
    arguments = _gather_paths(_configs_first(arguments))
    try:
        auto_cli(
            commands,
            args=arguments,
            prog=prog,
            description=description,
            formatter_class=_formatter(),
            exit_on_error=False,
        )
    except ArgumentError as error:
        return _fail(str(error), 2)
    except (OffbeatError, OSError) as error:
        return _fail(str(error), 1 if isinstance(error, ArithmeticError) else 2)
    except KeyboardInterrupt:
        return _fail("interrupted; the same command goes on from the last checkpoint", 130)
    return 0


def _configs_first(arguments: list[str]) -> list[str]:
    """Puts `--config FILE` before all else: what is typed wins over the file, in any order."""
    command, rest = arguments[:1], arguments[1:]
    configs: list[str] = []
    while any(a == "--config" or a.startswith("--config=") for a in rest):
        at = next(i for i, a in enumerate(rest) if a == "--config" or a.startswith("--config="))
        width = 2 if rest[at] == "--config" else 1
        configs += rest[at : at + width]
        rest = rest[:at] + rest[at + width :]
    return [*command, *configs, *rest]


def _gather_paths(arguments: list[str]) -> list[str]:
    """Makes one argument of the paths of a command that takes many: a list, as jsonargparse reads.

    Each option but --help stands before its value, or holds it after an equals sign.
    """
    command, rest = arguments[:1], arguments[1:]
    if not command or command[0] not in MANY_PATHS:
        return arguments
    paths: list[str] = []
    options: list[str] = []
    while rest:
        first = rest.pop(0)
        if not first.startswith("-"):
            paths.append(first)
            continue
        options.append(first)
        alone = "=" in first or first in ("-h", "--help") or first.startswith("--print_config")
        if not alone and rest:
            options.append(rest.pop(0))
    return [*command, *([json.dumps(paths)] if paths else []), *options]


def _fail(message: str, code: int) -> int:
    line = " ".join(message.split())
    print(f"offbeat: error: {line}", file=sys.stderr)
    return code


def _formatter() -> type:
    from jsonargparse import DefaultHelpFormatter

    class Formatter(DefaultHelpFormatter):
        """Leaves the lines of the description as they are."""

        def _fill_text(self, text: str, width: int, indent: str) -> str:
            return "".join(indent + line for line in text.splitlines(keepends=True))

    return Formatter
