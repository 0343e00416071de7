"""Registries: one form for models, parts, backends, readers, writers, robots and baselines."""

from __future__ import annotations

import importlib.metadata
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from offbeat.errors import InputError, one_of

T = TypeVar("T")


class Registry(Mapping[str, T], Generic[T]):
    """Entries by name. Names are listed in the order in which they were registered.

    Packages add entries by calling `register`, or by an entry point of `group`, which is loaded
    when an unknown name is looked up, or when all names are listed. An entry point is
    a function without arguments that registers, or that returns the entry.

    Args:
        what: kind of the entries, for messages: `cell`, `reader`.
        group: of entry points, such as `offbeat.models`; None for a registry without.
        adopt: converts the result of an entry point to an entry, or raises; by default it is one.

    Example:
        >>> CELLS: Registry[type] = Registry("cell")
        >>> CELLS.register("identity", object)
        <class 'object'>
    """

    def __init__(
        self,
        what: str,
        *,
        group: str | None = None,
        adopt: Callable[[Any], T] | None = None,
    ) -> None:
        self.what, self.group, self._adopt = what, group, adopt
        self._entries: dict[str, T] = {}
        self._loaded = group is None

    def register(self, name: str, entry: T, *, replace: bool = False) -> T:
        """Adds an entry; returns it.

        Args:
            name: of the entry.
            entry: its value.
            replace: allow a name that is taken.

        Raises:
            InputError: the name is empty or taken.
        """
        if not name or not isinstance(name, str):
            raise InputError(f"a {self.what} needs a name, got {name!r}")
        if name in self._entries and not replace:
            raise InputError(
                f"there is a {self.what} {name!r} already; choose another name, or pass "
                "replace=True"
            )
        self._entries[name] = entry
        return entry

    def unregister(self, name: str) -> None:
        """Removes an entry, for tests and notebooks that define one again."""
        self._entries.pop(name, None)

    def __getitem__(self, name: str) -> T:
        """The entry of a name.

        Raises:
            InputError: there is none; the message lists the names and the nearest one.
        """
        if name not in self._entries:
            self._load()
            one_of(self.what, name, self._entries)
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        if name not in self._entries:
            self._load()
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        self._load()
        return iter(tuple(self._entries))

    def __len__(self) -> int:
        self._load()
        return len(self._entries)

    def _load(self) -> None:
        """Loads the entry points of other packages, once."""
        if self._loaded or self.group is None:
            return
        self._loaded = True
        for point in importlib.metadata.entry_points(group=self.group):
            if point.name in self._entries:
                continue
            try:
                entry = point.load()
                made = entry() if callable(entry) and not isinstance(entry, type) else entry
                if made is not None and self._adopt is not None:
                    made = self._adopt(made)
            except Exception as error:  # another package's code must not stop this one
                warnings.warn(
                    f"the {self.what} {point.name!r} ({point.value}) of another package cannot be "
                    f"loaded: {type(error).__name__}: {error}",
                    stacklevel=3,
                )
                continue
            if made is not None and point.name not in self._entries:
                self._entries[point.name] = made
