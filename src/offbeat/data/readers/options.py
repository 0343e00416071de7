"""Options of several readers: names, and fields of topics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

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
