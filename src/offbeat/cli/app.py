"""The command `offbeat`: each subcommand is a function, its options are the function's arguments.

Torch and everything else that is slow to import is imported inside the functions, so that
`offbeat --help` is fast.
"""

from __future__ import annotations

import inspect
import logging
import os
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import Any

from offbeat.cli.clone import clone_command
from offbeat.cli.compare import compare_command
from offbeat.cli.demo import demo_command
from offbeat.cli.doctor import doctor_command
from offbeat.cli.evaluate import evaluate_command
from offbeat.cli.export import export_command
from offbeat.cli.forecast import forecast_command
from offbeat.cli.impute import impute_command
from offbeat.cli.inspect import inspect_command
from offbeat.cli.models import models_command
from offbeat.cli.predict import predict_command
from offbeat.cli.resample import resample_command
from offbeat.cli.rollout import rollout_command
from offbeat.cli.simulate import simulate_command
from offbeat.cli.stream import stream_command
from offbeat.cli.sweep import sweep_command
from offbeat.cli.train import train_command
from offbeat.errors import OffbeatError, of_system, printable

DESCRIPTION = """Learn robot motion from trajectories sampled at uneven times.

From a log to predictions, fills and forecasts with intervals:

  offbeat inspect arm.csv
  offbeat train arm.csv runs/arm
  offbeat impute runs/arm arm.csv filled.csv
  offbeat forecast runs/arm arm.csv ahead.csv --horizons 0.1,0.5
  offbeat resample arm.csv arm --rate_hz 30 --run runs/arm

From simulation to a scored model:

  offbeat simulate hopper.parquet --n_trajectories 2000
  offbeat train hopper.parquet runs/hopper --split.window 100 --split.observed_fraction 0.3
  offbeat evaluate runs/hopper hopper.parquet
  offbeat predict runs/hopper hopper.parquet predictions.csv
  offbeat impute runs/hopper hopper.parquet filled.csv
  offbeat forecast runs/hopper hopper.parquet ahead.csv --horizons 0.05,0.1

To see it at work in two minutes: offbeat demo"""


# The functions are not named after the commands: jsonargparse would find their namesakes in the
# lazy package `offbeat`, and import torch to look at them.
COMMANDS: dict[str, Any] = {
    "demo": demo_command,
    "inspect": inspect_command,
    "train": train_command,
    "impute": impute_command,
    "forecast": forecast_command,
    "resample": resample_command,
    "predict": predict_command,
    "evaluate": evaluate_command,
    "stream": stream_command,
    "export": export_command,
    "models": models_command,
    "simulate": simulate_command,
    "compare": compare_command,
    "sweep": sweep_command,
    "clone": clone_command,
    "rollout": rollout_command,
    "doctor": doctor_command,
}

ALIASES = {"forecast": ("extrapolate",)}
"""Aliases of commands."""


FREQUENT = {
    "train": (
        "budget_minutes",
        "horizon_s",
        "model.name",
        "baselines",
        "two_sided",
        "reader.format",
        "reader.time_column",
        "reader.time_unit",
        "seed",
        "device",
    ),
}
"""Options that `--help` shows first; by default those in no group. The rest is in `--help-all`."""


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
        argv: arguments after the program's name.
        prog: the program's name.
        description: for its help.
    """
    from argparse import ArgumentError

    from offbeat import __version__

    try:
        from offbeat.cli.option_groups import reader_options, training_options
        from offbeat.cli.parser import CommandParser
    except ModuleNotFoundError as error:
        given = list(sys.argv[1:] if argv is None else argv)
        if given[:1] == ["doctor"] and "doctor" in commands:  # it says what else is missing
            doctor_command(json="--json" in given)
            return 0
        return _missing(error)
    if sys.stderr is None:  # closed by the caller; progress bars and notes need one
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    groups = {"reader": reader_options, "training": training_options}
    usage = f"{prog} COMMAND [options] ..."
    parser = CommandParser(prog=prog, usage=usage, description=description, version=__version__)
    subcommands = parser.add_subcommands()
    names: dict[str, str] = {}
    parsers: dict[str, CommandParser] = {}
    for command, function in commands.items():
        said = inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:")[0]
        about = said.partition("\n\n")[0]
        parsers[command] = CommandParser(function, groups, FREQUENT.get(command), description=said)
        aliases = ALIASES.get(command, ())
        subcommands.add_subcommand(command, parsers[command], help=about, aliases=aliases)
        parsers[command].prog = f"{prog} {command}"
        names |= dict.fromkeys((command, *aliases), command)
    command = ""
    try:
        parsed = parser.parse_args(list(sys.argv[1:] if argv is None else argv) or ["--help"])
        command = names[parsed.subcommand]
        options = parser.instantiate(parsed)[parsed.subcommand].as_dict()
        options.pop("config", None)
        spoken = parsers[command].spoken
        with _said(spoken, quiet=options.pop("quiet"), verbose=options.pop("verbose")):
            commands[command](**options)
    except ArgumentError as error:
        return _fail(str(error), 2)
    except RecursionError:
        return _fail("a value is nested too deeply", 2)
    except BrokenPipeError:  # the reader of the output closed the pipe, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (OffbeatError, OSError) as error:
        if _is_a_later_rank() and not isinstance(error, ConnectionError):
            return 2  # the first rank says it
        said = of_system(error) if isinstance(error, OSError) else str(error)
        said = parsers[command].spoken(said) if command else said
        return _fail(said, 1 if isinstance(error, ArithmeticError | ConnectionError) else 2)
    except ModuleNotFoundError as error:
        return _missing(error)
    except KeyboardInterrupt:
        return _fail("interrupted; the same command continues from the last checkpoint", 130)
    return 0


class _Notes(logging.Handler):
    """Prints the warnings of the library in the words of the command line."""

    def __init__(self, spoken: Callable[[str], str]) -> None:
        super().__init__(logging.WARNING)
        self.spoken = spoken

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one line."""
        print(f"offbeat: {self.spoken(record.getMessage())}", file=sys.stderr)


@contextmanager
def _said(spoken: Callable[[str], str], *, quiet: bool, verbose: bool) -> Iterator[None]:
    """Standard error without notes and bars, or with the time and the place of an error."""
    if quiet:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stderr(nowhere):
            yield
        return
    logger = logging.getLogger("offbeat")
    handler: logging.Handler = _Notes(spoken)
    if not verbose:
        logger.addHandler(handler)
        try:
            yield
        finally:
            logger.removeHandler(handler)
        return
    began, handler = time.monotonic(), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    except Exception:
        traceback.print_exc()
        raise
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        print(f"offbeat: {time.monotonic() - began:.1f} s", file=sys.stderr)


def _is_a_later_rank() -> bool:
    """Whether `torchrun` started this process as one of several, and not as the first."""
    return os.environ.get("RANK", "0") != "0" and os.environ.get("WORLD_SIZE", "1") != "1"


def _missing(error: ModuleNotFoundError) -> int:
    """The exit code where a dependency is not installed; any other module that is missing raises.

    With torch, NumPy and safetensors alone, models are made, fitted and used in Python.
    """
    name = (error.name or "").split(".")[0]
    if name not in ("jsonargparse", "matplotlib", "PIL", "pyarrow", "scipy", "yaml"):
        raise error
    return _fail(
        f"this needs the package {name}, which is not installed; install it with "
        "pip install offbeat (python -m offbeat doctor lists what is missing)",
        2,
    )


_LONGEST = 500  # characters of a message, as paths may be long
_OF_PARSER = re.compile(
    r'Parser key "([^"]+)": (?:Does not validate against any of the Union subtypes Subtypes: '
    r"\[(.*?)\] Errors: .* Given value: (.*)|Expected an? (.*?)\. Got value: (.*))"
)


def _fail(message: str, code: int) -> int:
    line = printable(" ".join(message.split()))
    if found := _OF_PARSER.fullmatch(line):
        key, several, given, one, other = found.groups()
        expected = re.sub(r"typing\.|collections\.abc\.|<class '([^']*)'>", r"\1", several or one)
        expected = expected.replace("collections.abc.", "").replace("NoneType", "null")
        value = given if given is not None else other
        line = f"--{key} must be {expected}, got {value[:60]}{'...' if len(value) > 60 else ''}"
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST - 110]} ... {line[-100:]}"
    print(f"offbeat: error: {line}", file=sys.stderr)
    return code
