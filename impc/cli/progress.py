"""One bar for all that takes long."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tqdm import tqdm

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["progress"]


@contextmanager
def progress(
    total: int, unit: str, kept: Callable[[int], str] | None = None, begun: int = 0
) -> Iterator[Callable[[str], None]]:
    """A bar while the block lasts; what the block gets is told the name of each step that is done.

    Parameters
    ----------
    total : int
        Number of steps.
    unit : str
        What a step is called.
    kept : callable, optional
        Number of steps done -> what to say when the block is interrupted from the keyboard.
    begun : int
        Steps that were done before.

    Raises
    ------
    KeyboardInterrupt
        When the block is interrupted, with what `kept` says.
    """
    count = begun  # the bar's own stands still where there is no bar
    # disable=None: no bar where stderr is a file.
    with tqdm(
        total=total, initial=begun, unit=unit, file=sys.stderr, disable=None, leave=False
    ) as bar:

        def done(name: str) -> None:
            nonlocal count
            count += 1
            bar.set_postfix_str(name, refresh=False)
            bar.update()

        try:
            yield done
        except KeyboardInterrupt:
            if kept is None:
                raise
            raise KeyboardInterrupt(kept(count)) from None
