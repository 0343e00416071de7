"""The parts of a model: cells, vector fields and heads, each a class in a registry."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from offbeat.errors import InputError, one_of
from offbeat.parts.cells import CELLS, Cell
from offbeat.parts.fields import FIELDS, Perceptron
from offbeat.parts.heads import HEADS, Gaussian, Head, HeadShape, Point, Prediction
from offbeat.registry import Registry

__all__ = [
    "CELLS",
    "FIELDS",
    "HEADS",
    "Cell",
    "Gaussian",
    "Head",
    "HeadShape",
    "Perceptron",
    "Point",
    "Prediction",
    "register_part",
]

_KINDS: dict[str, Registry[type]] = {"cell": CELLS, "field": FIELDS, "head": HEADS}  # type: ignore[dict-item]

Part = TypeVar("Part", bound=Callable[..., object])


def register_part(kind: str, name: str, part: Part, *, replace: bool = False) -> Part:
    """Adds a part that models can be composed of.

    Args:
        kind: `cell` (a subclass of `parts.Cell`), `field` (called with `sizes` and `activation`,
            gives a module that maps a state to its derivative), or `head` (a subclass of
            `parts.Head`).
        name: what `ModelConfig.cell`, `.vector_field` or `.head` takes.
        part: the class.
        replace: allow a name that is taken.

    Returns:
        The part.

    Raises:
        InputError: unknown kind, a name that is taken, or a part that is no class.
    """
    one_of("kind of part", kind, _KINDS)
    if not callable(part):
        raise InputError(f"a part must be a class, got {part!r}")
    _KINDS[kind].register(name, part, replace=replace)  # type: ignore[arg-type]
    return part
