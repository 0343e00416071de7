"""The errors users meet. Every message says what it got, what was expected, and the fix."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType


class OffbeatError(Exception):
    """Base of every error that Offbeat raises on purpose."""


class InputError(OffbeatError, ValueError):
    """An argument, a config or an array is not what it must be."""


class FileFormatError(OffbeatError, ValueError):
    """A file is truncated, damaged, or not of the format that was asked for."""


class MissingExtraError(OffbeatError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class DivergenceError(OffbeatError, ArithmeticError):
    """A computation left the finite numbers: a loss turned to NaN, a solver ran out of steps."""


def require(module: str, extra: str) -> ModuleType:
    """Imports an optional dependency, or says in one line which extra brings it.

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
