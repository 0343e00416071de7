"""Progress bars, and how long a step takes, on a terminal; nothing without tqdm."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any


class _Silent:
    """A progress bar that shows nothing, with the methods of one of tqdm that are used here."""

    def __init__(self, items: Iterable[Any]) -> None:
        self._items = items

    def __iter__(self) -> Iterator[Any]:
        return iter(self._items)

    def __enter__(self) -> _Silent:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def update(self, n: float = 1) -> None:
        """Does nothing, as do the others."""

    def set_description(self, text: str) -> None:
        """Does nothing."""

    def set_postfix_str(self, text: str) -> None:
        """Does nothing."""

    def close(self) -> None:
        """Does nothing."""


def progress_bar(items: Iterable[Any] = (), *, show: bool = True, **options: Any) -> Any:
    """A progress bar of tqdm; one that shows nothing where tqdm is not installed.

    Args:
        items: that a loop goes over, with `total` left out.
        show: False shows nothing; nor is anything shown where standard error is no terminal.
        **options: of tqdm: `total`, `desc`, `unit`, ...
    """
    try:
        from tqdm import tqdm
    except ImportError:
        return _Silent(items)
    if "total" not in options:
        options["iterable"] = items
    return tqdm(disable=None if show else True, **options)


_AFTER_S = 2.0
_EVERY_S = 0.5


@contextmanager
def busy(what: str, show: bool = True) -> Iterator[None]:
    """Shows a step and its time on standard error once it takes more than two seconds.

    Nothing is shown where standard error is no terminal. Steps must not be nested, nor hold other
    progress bars.

    Args:
        what: the step, such as `filling`.
        show: False shows nothing.
    """
    if not show or sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    try:
        from tqdm import tqdm
    except ImportError:
        yield
        return
    ended = threading.Event()

    def wait() -> None:
        if ended.wait(_AFTER_S):
            return
        with tqdm(desc=what, bar_format="{desc}: {elapsed}", leave=False) as bar:
            bar.start_t -= _AFTER_S
            while not ended.wait(_EVERY_S):
                bar.refresh()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Clock:
    """A moment, for the time of a computation that other programs do not make longer.

    The difference of two moments is the time that passed, or the time that this process computed
    where that is less: on a busy machine it waits, and with several threads it computes at once.
    """

    def __init__(self) -> None:
        self.passed, self.computed = time.perf_counter(), time.process_time()

    def __sub__(self, earlier: Clock) -> float:
        """Time since an earlier moment, in s."""
        return min(self.passed - earlier.passed, self.computed - earlier.computed)
