"""Terminal output of commands: confirmation prompt, progress bar, list of written files.

If stderr is not a terminal, lines replace the bar. IMPC_QUIET=1 in the environment hides both, and
IMPC_PROGRESS=json replaces both by one JSON line for each step.
"""

from __future__ import annotations

import json
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
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from impc.cli.options import Page
    from impc.reporting.document import Report
    from impc.studies.cache import Cache
    from impc.studies.effort import Effort

# Seconds and GB above which a command asks first: two hours, half of a machine with 8 GB.
_LONG, _MUCH = 7200.0, 4.0


# Largest number of files of one kind that are listed by name.
_NAMED = 4
#: Remedy for a fit that is too large.
FEWER = "lower horizon, replicates or profiles in [fit], or shorten the trials"
#: Remedy for a parameter selection that is too large.
FEWER_STARTS = "lower replicates or starts in [select], or shorten the trials"


def require_consent(effort: Effort, given: bool, lower: str = FEWER) -> None:
    """Ask for confirmation before a large request, unless it is `given` by --yes."""
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
    if asked and click.confirm(f"impc: this request {problem}; continue?", err=True):
        return
    raise InputError("this request", problem, f"{lower}; or pass --yes")


# Seconds between two lines, and from the start to the first line.
_PAUSE = 10.0
# Seconds between two updates of the bar's clock.
_TICK = 1.0


@contextmanager
def progress(
    total: int, unit: str, kept: Callable[[int], str] | None = None
) -> Iterator[Callable[..., None]]:
    """Show a bar during the block; yield a function to call with the title of each done step.

    Pass it `found=True` for a step that an earlier run did. `kept(count)` is the message that an
    interruption prints.
    """
    machine = os.environ.get("IMPC_PROGRESS", "") == "json"
    quiet = os.environ.get("IMPC_QUIET", "") not in ("", "0")
    count = begun = 0  # a disabled bar does not count
    began = said = time.monotonic()
    # disable=None: no bar where stderr is a file.
    with (
        tqdm(
            total=total, unit=unit, file=sys.stderr, disable=machine or quiet or None, leave=False
        ) as bar,
        _ticking(bar),
    ):

        def say(title: str, left: float | None, found: bool) -> None:
            event = {"done": count, "total": total, "title": title, "left": left, "found": found}
            print(json.dumps(event), file=sys.stderr, flush=True)

        def done(title: str, *, found: bool = False) -> None:
            nonlocal count, begun, said
            count, begun = count + 1, begun + found
            bar.set_postfix_str(title, refresh=False)
            if found and not bar.disable:
                bar.initial += 1  # not part of the rate
            bar.update()
            now = time.monotonic()
            # No estimate from the first step: it may include compilation.
            known = count - begun > 1
            left = (now - began) * (total - count) / (count - begun) if known else None
            if machine:
                say(title, left, found)
            elif bar.disable and not quiet and now - said >= _PAUSE:
                said = now
                time_left = "" if left is None else f", about {left:.0f} s left"
                which = f" ({title})" if title else ""
                line = f"{count} of {total} {unit}s{which}{time_left}"
                print(line, file=sys.stderr, flush=True)

        if machine:
            say("", None, False)
        try:
            yield done
        except KeyboardInterrupt:
            if kept is None:
                raise
            raise KeyboardInterrupt(kept(count)) from None


@contextmanager
def _ticking(bar: tqdm[Any]) -> Iterator[None]:
    """Redraw the bar every second, so that a long step does not look like a hang."""
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


def publish(
    report: Report,
    out: Path,
    page: Page,
    *texts: str,
    kept: Cache | None = None,
    files: Mapping[str, bytes] | None = None,
) -> None:
    """Write a report or its `files`, drop what was kept, print verdict, `texts` and files."""
    from impc.reporting.writer import write_files  # noqa: PLC0415

    written = write_files(out, report.files(pdf=page.pdf) if files is None else files)
    if kept is not None:
        kept.forget()
    for text in (report.verdict.text(), *texts):
        click.echo(text)
    print_files(out, written, page.open)


def print_files(out: Path, written: Sequence[Path], open_page: bool = False) -> None:
    """Print the path of the report first, then the other files `written` to the folder `out`."""
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
    """Print the next command to type: `command` with the files `names` of the folder `out`."""
    folder = shlex.quote(one_line(out))
    click.echo(f"next: {command.format(*(f'{folder}/{name}' for name in names))}")
