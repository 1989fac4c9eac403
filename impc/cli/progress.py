"""One bar for all that takes long; lines where no bar can be drawn, as in a pipe or a log.

With IMPC_QUIET=1 in the environment there is neither, for scripts that read what is said.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# Seconds between two lines, and from the start to the first: what is quick says nothing.
_PAUSE = 10.0
# The clock of a bar goes on while a step takes long, in seconds.
_TICK = 1.0


@contextmanager
def progress(
    total: int, unit: str, kept: Callable[[int], str] | None = None
) -> Iterator[Callable[..., None]]:
    """A bar while the block lasts; the block gets what is called with each step done.

    It is called with the step's name, and `found=True` where an earlier run had done it.
    """
    quiet = os.environ.get("IMPC_QUIET", "") not in ("", "0")
    count = begun = 0  # the bar's own stands still where there is no bar
    began = said = time.monotonic()
    # disable=None: no bar where stderr is a file.
    with (
        tqdm(total=total, unit=unit, file=sys.stderr, disable=quiet or None, leave=False) as bar,
        _ticking(bar),
    ):

        def done(name: str, *, found: bool = False) -> None:
            nonlocal count, begun, said
            count, begun = count + 1, begun + found
            bar.set_postfix_str(name, refresh=False)
            if found and not bar.disable:
                bar.initial += 1  # no part of the rate
            bar.update()
            now = time.monotonic()
            if bar.disable and not quiet and now - said >= _PAUSE:
                said = now
                left = (now - began) * (total - count) / max(count - begun, 1)
                # The first step may have compiled what the others use: it tells nothing of them.
                time_left = f", about {left:.0f} s left" if count - begun > 1 else ""
                which = f" ({name})" if name else ""
                line = f"{count} of {total} {unit}s{which}{time_left}"
                print(line, file=sys.stderr, flush=True)

        try:
            yield done
        except KeyboardInterrupt:
            if kept is None:
                raise
            raise KeyboardInterrupt(kept(count)) from None


@contextmanager
def _ticking(bar: tqdm[Any]) -> Iterator[None]:
    """Draw a bar anew each second, so that nobody takes a long step for a stop."""
    if bar.disable:
        yield
        return
    over = threading.Event()

    def tick() -> None:
        while not over.wait(_TICK):
            bar.refresh()

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
