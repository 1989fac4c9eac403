"""The `impc` command: it parses, calls and prints; there is no mathematics here."""

from __future__ import annotations

import functools
import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import click
from tqdm import tqdm

from impc.errors import ImpcError, InputError
from impc.example import CASES, run_case
from impc.plant import as_plant
from impc.report.example_report import example_files
from impc.report.table import determined, text_table
from impc.report.write import write_files

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["main"]

_P = ParamSpec("_P")
_T = TypeVar("_T")

_METHODS = 7
_EXAMPLE_PLANT = "plants:yalmip_example"


@click.group()
@click.version_option(package_name="impc")
def main() -> None:
    """Inverse model predictive control: the weights behind a recorded closed loop."""


def _one_line_errors(command: Callable[_P, _T]) -> Callable[_P, _T]:
    """End with one line and a status instead of a traceback: 2 for bad input, 130 for Ctrl-C."""

    @functools.wraps(command)
    def guarded(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        try:
            return command(*args, **kwargs)
        except ImpcError as error:
            click.echo(f"impc: error: {error}", err=True)
            sys.exit(2)
        except KeyboardInterrupt:
            click.echo("impc: interrupted; nothing was written", err=True)
            sys.exit(130)

    return guarded


@main.command()
@click.option(
    "--case",
    type=click.Choice([*CASES, "all"]),
    default="all",
    show_default=True,
    help="Initial state: A (1, 3), B (2, 3), C (2, 1).",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("results/example"),
    show_default=True,
    help="Folder for the report, the figures and result.json.",
)
@_one_line_errors
def example(case: str, out: Path) -> None:
    """Recover known weights from a simulated recording, by seven methods (section 3.4)."""
    click.echo(
        "Simulation example of section 3.4. The dissertation's own matrices are lost; this plant is "
        "a stand-in\nwith what its text says: unstable, |u| <= 1, true weights Q = I, R = 1.\n"
    )
    plant = as_plant(_named_plant(_EXAMPLE_PLANT))
    names = list(CASES) if case == "all" else [case]
    results = []
    with tqdm(total=_METHODS * len(names), unit="method", leave=False, disable=None) as bar:
        for name in names:
            bar.set_description(f"case {name}")
            results.append(run_case(plant, name, progress=lambda _: bar.update()))
    written = write_files(out, example_files(results))
    for result in results:
        start = ", ".join(f"{value:g}" for value in result.x0)
        click.echo(f"case {result.name}, x0 = ({start}), {result.branch} branch of Table 3.1")
        click.echo(text_table(result))
        click.echo(determined(result) + "\n")
    click.echo(f"{len(written)} files in {out}; open {out / 'report.html'}")


def _named_plant(path: str) -> Any:
    """Import `module:function` and call it: the only code that a name can run."""
    module, _, function = path.partition(":")
    try:
        return getattr(importlib.import_module(module), function)()
    except (ImportError, AttributeError) as error:
        raise InputError(
            "plant", f"{path!r} cannot be imported ({error})", "name it as module:function"
        ) from None
