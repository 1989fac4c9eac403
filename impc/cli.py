"""The `impc` command: parses, calls, prints. No mathematics."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from impc.errors import ImpcError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.example import CaseResult
    from impc.plant import Plant

__all__ = ["main"]

# The library knows no plant: the example's is named by its import path, ``module:function``.
_EXAMPLE_PLANT = "plants:yalmip_example"
_BAD_INPUT, _INTERRUPTED = 2, 130


class _Program(click.Group):
    """Ends every expected failure with one line on stderr: no usage text, no traceback."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            status = super().main(*args, **kwargs | {"standalone_mode": False})
        except (ImpcError, click.ClickException) as error:
            message = error.format_message() if isinstance(error, click.ClickException) else error
            click.echo(f"impc: error: {message}", err=True)
            sys.exit(_BAD_INPUT)
        sys.exit(status)

    def invoke(self, ctx: click.Context) -> Any:
        # Caught here, because click's own handling prints an empty line first.
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("impc: interrupted", err=True)
            ctx.exit(_INTERRUPTED)


@click.group(cls=_Program, invoke_without_command=True)
@click.version_option(package_name="impc", prog_name="impc")
@click.pass_context
def main(context: click.Context) -> None:
    """Inverse model predictive control: the weights behind a recorded closed loop."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


@main.command()
@click.option(
    "--case",
    type=click.Choice(["A", "B", "C", "all"]),
    default="all",
    show_default=True,
    help="Initial state: A (1, 3), B (2, 3), C (2, 1).",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("results", "example"),
    show_default=True,
    help="Folder for report.html, result.json and the figures.",
)
def example(case: str, out: Path) -> None:
    """Run the simulation example of section 3.4 of the dissertation.

    The dissertation's own matrices, initial state and bound are lost; a plant that shows
    everything its text says stands in for them.
    """
    # Imported here: the libraries take seconds to load, and --help and --version need none.
    from impc.example import CASES  # noqa: PLC0415
    from impc.report.example_report import example_files  # noqa: PLC0415
    from impc.report.provenance import LOST, example_provenance  # noqa: PLC0415
    from impc.report.write import require_writable, write_files  # noqa: PLC0415

    require_writable(out)
    plant = _load_plant(_EXAMPLE_PLANT)
    cases = _run(plant, tuple(CASES) if case == "all" else (case,))
    files = example_files(cases, example_provenance(_EXAMPLE_PLANT, plant))
    written = write_files(out, files)
    click.echo(click.wrap_text(LOST, width=100))
    for result in cases:
        _print_case(result)
    _print_files(out, written)


def _run(plant: Plant, names: Sequence[str]) -> list[CaseResult]:
    from impc.example import run_case  # noqa: PLC0415
    from impc.report.table import METHODS  # noqa: PLC0415

    total = len(names) * (len(METHODS) - 1)  # the truth is no method
    # disable=None: no bar where stderr is a file.
    with tqdm(total=total, unit="method", file=sys.stderr, disable=None, leave=False) as bar:

        def step(method: str) -> None:
            bar.set_postfix_str(method, refresh=False)
            bar.update()

        return [run_case(plant, name, progress=step) for name in names]


def _load_plant(path: str) -> Plant:
    from impc.plant import as_plant  # noqa: PLC0415

    module, _, function = path.partition(":")
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"plant {path}", f"cannot be imported ({error})", "install the whole checkout"
        ) from None
    return as_plant(make())


def _print_case(result: CaseResult) -> None:
    from impc.report.table import determined_sentences, text_table  # noqa: PLC0415

    start = ", ".join(f"{value:g}" for value in result.x0)
    click.echo(f"\nCase {result.name}: start at ({start}), {result.branch} branch of Table 3.1\n")
    click.echo(text_table(result) + "\n")
    for line in determined_sentences(result.identifiability):
        click.echo(line)


def _print_files(out: Path, written: Sequence[Path]) -> None:
    kinds: dict[str, list[str]] = {}
    for path in written:
        kinds.setdefault(path.stem, []).append(path.suffix)
    click.echo(f"\nWritten to {out}:")
    for stem, suffixes in kinds.items():
        click.echo(f"  {stem}{' '.join(suffixes)}")


if __name__ == "__main__":
    main()
