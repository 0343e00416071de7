"""Options of several readers: names, and fields of topics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from offbeat.data.cleaning.options import is_number
from offbeat.errors import InputError, one_of


def names(option: str, given: Iterable[str] | None) -> tuple[str, ...] | None:
    """The names given by an option: several, one as a plain string, or None.

    Raises:
        InputError: they are not names, or there are none.
    """
    if given is None:
        return None
    listed = (given,) if isinstance(given, str) else given
    if isinstance(listed, Mapping) or not isinstance(listed, Iterable):
        raise InputError(f"{option} must be one name or more, got {given!r}")
    listed = tuple(listed)
    if not listed or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{option} must be one name or more, got {given!r}")
    return tuple(dict.fromkeys(listed))


def check_types(options: Mapping[str, Any], described: Any, where: str) -> None:
    """Checks options against the annotations of a function or of the fields of a class.

    Args:
        options: by name; those that are not annotated are not checked.
        described: the function or class.
        where: for messages.

    Raises:
        InputError: an option has another type.
    """
    try:
        hints = get_type_hints(described)
    except (NameError, TypeError):  # of a reader of another package
        return
    for name, value in options.items():
        if name in hints and not fits(value, hints[name]):
            expected = str(hints[name]).removeprefix("<class '").removesuffix("'>")
            for start in ("typing.", "collections.abc."):
                expected = expected.replace(start, "")
            shown = repr(value) if len(repr(value)) < 60 else type(value).__name__
            raise InputError(f"{name}{where} must be {expected}, got {shown}")


def fits(value: Any, hint: Any) -> bool:
    """Whether a value has an annotated type. A single name counts as a sequence of names."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(fits(value, one) for one in inner)
    if origin is Literal:
        return isinstance(value, str)
    if origin is not None and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            fits(key, inner[0]) and fits(one, inner[1]) for key, one in value.items()
        )
    if origin is not None and issubclass(origin, Sequence):
        if isinstance(value, str):
            return str in inner
        listed = isinstance(value, list | tuple | set | frozenset | range)
        return listed and all(fits(one, inner[0]) for one in value)
    if hint is float:
        return is_number(value) or (isinstance(value, float) and not isinstance(value, bool))
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, hint) if isinstance(hint, type) else True


class Fields:
    """The selected fields of topics; records which of them were found.

    A field is selected by its path, which includes all fields below: `pose` has `pose.position.x`
    and `q` has `q[0]`. `topic:path` selects it in one topic only.

    Args:
        fields: selected fields; None for the defaults of the format.
        topics: the topics that are read.

    Raises:
        InputError: a topic is not one of these.
    """

    def __init__(self, fields: Iterable[str] | None, topics: Iterable[str]) -> None:
        self.available: dict[str, None] = {}
        self._met: set[tuple[str, str]] = set()
        self._patterns: list[tuple[str, str]] | None = None
        listed = names("fields", fields)
        if listed is None:
            return
        self._patterns = []
        known = sorted(topics)
        for text in listed:
            topic, colon, path = text.rpartition(":")
            if colon:
                one_of(f"topic of field {text!r}", topic, known)
            self._patterns.append((topic, path))

    def of(self, topic: str) -> Callable[[str], bool] | None:
        """Returns a test whether a channel of this topic is selected; None for the defaults."""
        if self._patterns is None:
            return None
        mine = [pattern for pattern in self._patterns if pattern[0] in ("", topic)]

        def wanted(name: str) -> bool:
            met = [pattern for pattern in mine if below(name, pattern[1])]
            self._met.update(met)
            return bool(met)

        return wanted

    def check(self) -> None:
        """Raises `InputError` for a field that no topic has; lists the available ones."""
        for pattern in self._patterns or ():
            if pattern not in self._met:
                one_of("field", pattern[1], self.available)


def below(name: str, path: str) -> bool:
    """Whether a channel is this field, or part of it."""
    return name.startswith(path) and name[len(path) : len(path) + 1] in ("", ".", "[")
