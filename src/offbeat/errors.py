"""Errors. Messages contain what was given, what was expected, and the fix."""

from __future__ import annotations

import difflib
import errno
import importlib
import itertools
import math
import os
import unicodedata
from collections.abc import Iterable, Sequence
from types import ModuleType


def printable(text: str) -> str:
    r"""A text whose control characters are escaped, so that a terminal shows it and obeys none.

    Names in files may hold any character. Line ends and tabs stay; others that are not printed,
    such as escape sequences and marks that reverse the direction of writing, become `\x1b`.
    """
    if text.isprintable():
        return text
    return "".join(ascii(c)[1:-1] if _is_control(c) else c for c in text)


_DIRECTIONS = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def _is_control(character: str) -> bool:
    kind = unicodedata.category(character)
    return character in _DIRECTIONS or (
        kind in ("Cc", "Cs", "Zl", "Zp") and character not in "\n\t"
    )


class OffbeatError(Exception):
    """Base class of all errors of Offbeat; a message holds no control characters."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(printable(arg) if isinstance(arg, str) else arg for arg in args))


class InputError(OffbeatError, ValueError):
    """An argument, a config or an array is invalid."""


class FileFormatError(OffbeatError, ValueError):
    """A file is truncated, damaged, or not of the expected format."""


class NoLogError(FileFormatError):
    """A table has no rows, or no times: it may be about a log, and is none."""


class MissingExtraError(OffbeatError, ImportError):
    """An optional dependency is not installed; the message names the extra that installs it."""


class DivergenceError(OffbeatError, ArithmeticError):
    """A computation diverged: a loss is NaN, or a solver exceeded its number of steps."""


_MOST_SHOWN, _MOST_COMPARED = 240, 2000  # characters of a message, choices compared
_LONGEST_SHOWN = 60  # characters of what was given


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


def one_of(what: str, got: str, choices: Iterable[str], *, whole: bool = False) -> str:
    """Returns `got` when it is one of `choices`.

    Args:
        what: is chosen, for the message.
        got: was given.
        choices: that there are.
        whole: list all of them, however long the message becomes.

    Raises:
        InputError: it is not; the message lists the choices, as many as fit, and the nearest one.
    """
    known = sorted(choices)
    if isinstance(got, str) and got in known:
        return got
    near = difflib.get_close_matches(str(got)[:1000], known[:_MOST_COMPARED], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    given = repr(got)
    if len(given) > _LONGEST_SHOWN:
        given = f"{given[:_LONGEST_SHOWN]}..."
    room = math.inf if whole else _MOST_SHOWN - len(what) - len(given) - len(hint)
    lengths = itertools.accumulate(len(name) + 2 for name in known)
    listed = sum(1 for _ in itertools.takewhile(lambda length: length <= room, lengths))
    more = f" and {len(known) - listed} more" if listed < len(known) else ""
    shown = ", ".join(known[:listed]) + more
    raise InputError(f"unknown {what} {given}, expected one of: {shown}{hint}")


def listed(names: Sequence[str], most: int = 20, *, quoted: bool = False) -> str:
    """Names for messages and notes.

    Of many or long names, the first ones are given, and the number of the rest.

    Args:
        names: to list.
        most: of them that are given.
        quoted: put each of them in quotes.
    """
    shown = [f"{name[:36]}..." if len(name) > 40 else name for name in names[:most]]
    shown = [repr(name) if quoted else repr(name)[1:-1] for name in shown]
    lengths = itertools.accumulate(len(name) + 2 for name in shown)
    fit = max(sum(1 for _ in itertools.takewhile(lambda n: n <= _LONGEST_LIST, lengths)), 1)
    more = f" and {len(names) - fit} more" if len(names) > fit else ""
    return ", ".join(shown[:fit]) + more


_LONGEST_LIST = 160
"""Characters of names in a message."""


def of_system(error: OSError) -> str:
    """What an error of the system says to a user: which file it is about, and what to do.

    Args:
        error: of an operation on a file.
    """
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        where, why = error.filename or "the output", os.strerror(error.errno)
        return f"{where} can't be written: {why}; free some space, then repeat the command"
    if not error.strerror:
        return str(error)
    where = error.filename or "the output can't be written"
    return f"{where}: {error.strerror}"
