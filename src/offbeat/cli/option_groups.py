"""Options of arguments that are mappings: those of readers, and of trainings."""

from __future__ import annotations

import inspect
import re
import typing
from dataclasses import fields
from typing import Any, Literal

from offbeat.cli.parser import Option
from offbeat.config import TrainConfig


def training_options() -> list[Option]:
    """The fields of `TrainConfig`; by default those of the model's recipe."""
    return _fields(TrainConfig)


def reader_options() -> list[Option]:
    """Options of `offbeat.read`: `format`, those of all formats, and those of each."""
    from offbeat.data.readers import READERS
    from offbeat.data.recording import ReaderOptions

    options = {"format": Option("format", str, "name of the format; by default found in the file")}
    options["files"] = Option(
        "files",
        Literal["auto", "episodes", "merge"],
        "of a folder of files, each holds episodes, or a sensor of one recording",
    )
    options |= {option.name: option for option in _fields(ReaderOptions)}
    formats: dict[str, list[str]] = {}
    for reader in READERS.values():
        types, helps = typing.get_type_hints(reader.function), _described(reader.function)
        for name, parameter in inspect.signature(reader.function).parameters.items():
            if parameter.kind is not inspect.Parameter.KEYWORD_ONLY:
                continue
            kind: Any = types.get(name, str | int | float | bool | None)
            if name in options and name not in formats:
                options[name] = options[name]._replace(type=options[name].type | kind)
            elif name in options:
                options[name] = options[name]._replace(type=options[name].type | kind)
                formats[name].append(reader.name)
            else:
                options[name] = Option(name, kind, helps.get(name, ""))
                formats[name] = [reader.name]
    for name, of in formats.items():
        options[name] = options[name]._replace(help=f"({', '.join(of)}) {options[name].help}")
    return list(options.values())


def _fields(config: type) -> list[Option]:
    types, helps = typing.get_type_hints(config), _described(config)
    return [
        Option(field.name, types[field.name], helps.get(field.name, "")) for field in fields(config)
    ]


def _described(documented: Any) -> dict[str, str]:
    """The description of each argument or attribute in a docstring, on one line."""
    text = inspect.getdoc(documented) or ""
    section = re.search(r"^(?:Args|Attributes):\n((?:(?: .*)?\n?)*)", text, re.MULTILINE)
    found = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section[1] if section else "", re.M)
    return {name: " ".join(said.split()) for name, said in found}
