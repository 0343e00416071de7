"""Options that readers of topics and tables share: names, and fields of topics."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from offbeat.errors import InputError, one_of


def names(option: str, given: Iterable[str] | None) -> tuple[str, ...] | None:
    """The names that an option gives: several, one as a plain string, or None.

    Raises:
        InputError: they are no names, or there are none.
    """
    if given is None:
        return None
    listed = (given,) if isinstance(given, str) else tuple(given)
    if not listed or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{option} must be one name or more, got {given!r}")
    return tuple(dict.fromkeys(listed))


class Fields:
    """Which fields of which topics are asked for; remembers which of them it met.

    A field is asked for by its path, which means all below it, too: `pose` has `pose.position.x`
    and `q` has `q[0]`. `topic:path` asks for it in one topic alone.

    Args:
        fields: what is asked for; None for the defaults of the format.
        topics: the topics that are read.

    Raises:
        InputError: a topic is none of these.
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
        """Whether a channel of this topic is asked for; None where the defaults hold."""
        if self._patterns is None:
            return None
        mine = [pattern for pattern in self._patterns if pattern[0] in ("", topic)]

        def wanted(name: str) -> bool:
            met = [pattern for pattern in mine if below(name, pattern[1])]
            self._met.update(met)
            return bool(met)

        return wanted

    def check(self) -> None:
        """Raises `InputError` for a field that no topic has; it lists those `available`."""
        for pattern in self._patterns or ():
            if pattern not in self._met:
                one_of("field", pattern[1], self.available)


def below(name: str, path: str) -> bool:
    """Whether a channel is this field, or part of it."""
    return name.startswith(path) and name[len(path) : len(path) + 1] in ("", ".", "[")
