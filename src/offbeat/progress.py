"""How long a step takes, shown on a terminal while it runs."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

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
    from tqdm import tqdm

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
