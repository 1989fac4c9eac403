"""What commands say: a question before hours of work, a bar meanwhile, the files at the end.

The bar becomes lines where none can be drawn, as in a pipe or a log. With IMPC_QUIET=1 in the
environment there is neither, for scripts that read what is said.
"""

from __future__ import annotations

import os
import shlex
import sys
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from impc.errors import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from impc.studies.effort import Effort

# What is begun without a question: two hours, and what a machine of 8 GB has to spare.
_LONG, _MUCH = 7200.0, 4.0


# Files of one kind that are named one by one.
_NAMED = 4
#: What to do about a large request of a fit.
FEWER = "lower horizon, replicates or profiles in [fit], or shorten the trials"
#: What to do about one of a selection of parameters.
FEWER_STARTS = "lower replicates or starts in [select], or shorten the trials"


def require_consent(effort: Effort, given: bool, lower: str = FEWER) -> None:
    """Ask before a large request is begun, unless consent is `given` by --yes."""
    import psutil  # noqa: PLC0415  # --help needs none

    from impc.errors import InputError  # noqa: PLC0415

    needs = f"would need {effort.gigabytes:.3g} GB of memory"
    if effort.gigabytes > psutil.virtual_memory().total / 1e9:
        raise InputError("this request", f"{needs}, more than this machine has", lower)
    if given or (effort.seconds <= _LONG and effort.gigabytes <= _MUCH):
        return
    takes = f"would take about {effort.seconds / 3600:.3g} hours"
    problem = needs if effort.seconds <= _LONG else takes
    asked = sys.stdin is not None and sys.stdin.isatty()
    if asked and click.confirm(f"impc: this request {problem}; go on?", err=True):
        return
    raise InputError("this request", problem, f"{lower}; or say --yes")


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
                # The first step may have compiled what the others use: it says nothing of them.
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


def print_files(out: Path, written: Sequence[Path], open_page: bool = False) -> None:
    """Name the page first, then the other files `written` to the folder `out`."""
    page = out / "report.html"
    if page in written:
        click.echo(f"Open {one_line(page)}")
    kinds: dict[str, list[str]] = {}
    for path in written:
        if path != page:
            kinds.setdefault(path.suffix, []).append(path.name)
    for suffix, names in kinds.items():
        many = f"{len(names)} {suffix[1:]} files" if len(names) > _NAMED else ", ".join(names)
        click.echo(f"  {many}")
    if open_page:
        click.launch(str(page))


def print_next(command: str, out: Path, *names: str) -> None:
    """Say in one line what to type next: `command` with files of the folder `out`."""
    folder = shlex.quote(one_line(out))
    click.echo(f"next: {command.format(*(f'{folder}/{name}' for name in names))}")
