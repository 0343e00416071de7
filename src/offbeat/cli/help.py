"""How the help of a command is set: plain types, and defaults where there are any."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Union, get_args, get_origin

from jsonargparse import ArgumentParser, DefaultHelpFormatter

_TYPES = {Path: "path", str: "text", int: "integer", float: "number", bool: "true or false"}
_SUBCOMMANDS = re.compile(r"^subcommands:\n.*?\(required\)\n", re.MULTILINE | re.DOTALL)


class Formatter(DefaultHelpFormatter):
    """Keeps the paragraphs and indented lines of a description, and names types in plain words."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = text.split("\n\n")
        kept = (p if "\n  " in f"\n{p}" else textwrap.fill(p, width) for p in paragraphs)
        return textwrap.indent("\n\n".join(kept), indent)

    def _expand_help(self, action: argparse.Action) -> str:
        return re.sub(r"\bNone\b", "null", str(super()._expand_help(action)))  # as in YAML

    def _format_action_invocation(self, action: argparse.Action) -> str:
        given = action.option_strings
        action.option_strings = [name for name in given if not name.endswith("+")]
        try:
            return str(super()._format_action_invocation(action))
        finally:
            action.option_strings = given

    def _get_type_str(self, action: argparse.Action) -> str | None:
        if action.nargs == 0 or isinstance(action, argparse._SubParsersAction):
            return None
        kind: Any = getattr(action, "_typehint", None) or action.type
        kind = getattr(kind, "kind", kind)  # of a list that may be typed as a,b
        if get_origin(kind) is Literal and action.option_strings:  # its choices stand in its name
            return None
        return None if kind is None else in_words(kind)

    def _get_help_string(self, action: argparse.Action) -> str:
        said = str(super()._get_help_string(action))
        if action.default is None or (action.nargs == 0 and action.default is False):
            said = re.sub(r"(\(|, )default: %\(default\)s", r"\1", said)
        return re.sub(r"(, \)|,\)|\(\))$", lambda m: ")" if "," in m[0] else "", said).rstrip()


def in_words(kind: Any) -> str:
    """The name of a type in the help: `number`, `list of text`, `text or integer`.

    Args:
        kind: a type, as an annotation.
    """
    origin, within = get_origin(kind), get_args(kind)
    if origin is NotRequired:
        return in_words(within[0])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(in_words(k) for k in within if k is not NoneType))
    if origin is Literal:
        return f"one of {', '.join(str(value) for value in within)}"
    found = origin or kind
    if isinstance(found, type) and issubclass(found, Mapping):
        return "JSON"
    if origin is not None and issubclass(origin, Sequence):
        items = dict.fromkeys(in_words(k) for k in within if k is not Ellipsis)
        return f"list of {' or '.join(items)}"
    return "YAML" if is_dataclass(kind) else _TYPES.get(kind, getattr(kind, "__name__", str(kind)))


def of_commands(parser: ArgumentParser, text: str) -> str:
    """The help of a program with commands, with a plain heading over them.

    Args:
        parser: of the program.
        text: its help, as argparse sets it.
    """
    heading = f"commands, each with `{parser.prog} COMMAND --help`:\n"
    return _SUBCOMMANDS.sub(heading, text)
