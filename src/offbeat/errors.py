"""Errors. Messages contain what was given, what was expected, and the fix."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType


class OffbeatError(Exception):
    """Base class of all errors of Offbeat."""


class InputError(OffbeatError, ValueError):
    """An argument, a config or an array is invalid."""


class FileFormatError(OffbeatError, ValueError):
    """A file is truncated, damaged, or not of the expected format."""


class MissingExtraError(OffbeatError, ImportError):
    """An optional dependency is not installed; the message names the extra that installs it."""


class DivergenceError(OffbeatError, ArithmeticError):
    """A computation diverged: a loss is NaN, or a solver exceeded its number of steps."""


def require(module: str, extra: str) -> ModuleType:
    """Imports an optional dependency.

    Args:
        module: dotted name of the module to import.
        extra: name of the extra of this package that installs it.

    Raises:
        MissingExtraError: the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs {module!r}, which is not installed ({error}); "
            f"install it with: pip install 'offbeat[{extra}]'"
        ) from None


def one_of(what: str, got: str, choices: Iterable[str]) -> str:
    """Returns `got` when it is one of `choices`.

    Raises:
        InputError: it is not; the message lists the choices and the nearest one.
    """
    known = sorted(choices)
    if got in known:
        return got
    near = difflib.get_close_matches(str(got), known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(f"unknown {what} {got!r}, expected one of: {', '.join(known)}{hint}")
