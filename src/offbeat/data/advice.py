"""The command that trains on a log, and what it will choose."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from offbeat.data.plan import CHOSEN, plan
from offbeat.data.trajectory import Dataset


@dataclass(frozen=True)
class Advice:
    """A recommended command line of `train`.

    Attributes:
        command: its words, to be joined with `shlex.join`.
        reasons: a sentence for each choice that it makes.
    """

    command: tuple[str, ...]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        """The command line, with a line break before each option."""
        lines = [list(self.command[:4])]
        for word in self.command[4:]:
            lines[-1].append(word) if not word.startswith("--") else lines.append([word])
        return " \\\n    ".join(shlex.join(line) for line in lines)


def advise(
    dataset: Dataset,
    data: str,
    out: str = "runs/log",
    *,
    reader: Mapping[str, Any] | None = None,
    known: Sequence[str] = CHOSEN,
) -> Advice:
    """The command that trains on a data set: `train` chooses everything but how the log is read.

    Args:
        dataset: as read.
        data: its file, for the command line.
        out: folder of the run.
        reader: options that it was read with.
        known: the options that its format has.

    Raises:
        InputError: nothing can be learned from it, see `plan`.
    """
    chosen = plan(dataset, reader=reader, known=known)
    words = [f"--reader.{name}={_text(value)}" for name, value in (reader or {}).items()]
    return Advice(("offbeat", "train", data, out, *words), chosen.notes)


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_quoted(str(item)) for item in value) + "]"
    return "null" if value is None else str(value)


def _quoted(text: str) -> str:
    """Quotes a string for YAML."""
    plain = text.replace("_", "").replace(".", "").isalnum() and text[0].isalpha()
    # Such as null, yes and 1e3, which are no texts in YAML.
    return text if plain and yaml.safe_load(text) == text else json.dumps(text)
