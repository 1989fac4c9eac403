"""Options that several commands share."""

from __future__ import annotations

import functools
import importlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import click

from impc.cli.plant import KNOWN, asked_subject

if TYPE_CHECKING:
    from collections.abc import Callable

    from click import Context, Parameter

F = TypeVar("F", bound="Callable[..., Any]")

#: Trial k is drawn with the seed 100 seed + k, which must fit into 64 bits.
LARGEST_SEED = 10**15

#: --seed of the commands that simulate.
seed_option = click.option(
    "--seed",
    type=click.IntRange(0, LARGEST_SEED),
    default=0,
    help="Seed of all random numbers.",
)

#: --solver; the names are those of `impc.control.named_solver`, which is not loaded for --help.
solver_option = click.option(
    "--solver",
    help="Solver of the controller's quadratic programs: compiled (part of impc; default), or "
    "daqp, qpoases or ipopt of CasADi. For your own optimal control problem: ipopt, sqpmethod or "
    "fatrop.",
)

#: --yes of commands that may take hours, see `impc.cli.console`.
yes_option = click.option(
    "--yes", is_flag=True, help="Do not ask before a request of hours or much memory."
)


def runs(place: str) -> Callable[[F], F]:
    """Call ``module:function`` of impc.cli as the command; --help does not load its libraries."""

    def added(command: F) -> F:
        @functools.wraps(command)
        def running(**given: Any) -> Any:
            module, _, name = place.partition(":")
            return getattr(importlib.import_module(f"impc.cli.{module}"), name)(**given)

        return cast("F", running)

    return added


class Page(NamedTuple):
    """Options of a command that writes a report."""

    pdf: bool
    open: bool


def page_options(command: F) -> F:
    """Add --pdf and --open to a `command` that writes a report; passed on as `page`."""
    pdf = click.option("--pdf", is_flag=True, help="Also write the figures as PDF.")
    shown = click.option("--open", "open_page", is_flag=True, help="Open the report in a browser.")

    @functools.wraps(command)
    def paged(*given: Any, pdf: bool, open_page: bool, **named: Any) -> Any:
        return command(*given, page=Page(pdf, open_page), **named)

    return pdf(shown(cast("F", paged)))


def out_option(folder: str, holds: str) -> Callable[[F], F]:
    """Add --out, by default `folder` inside results/; the command locks it (`owned`)."""

    def added(command: F) -> F:
        @functools.wraps(command)
        def holding(*given: Any, out: Path, **named: Any) -> Any:
            from impc.reporting.writer import owned  # noqa: PLC0415

            with owned(out, _command_name(click.get_current_context())):
                return command(*given, out=out, **named)

        option = click.option(
            "--out",
            type=click.Path(path_type=Path),
            default=Path("results", folder),
            help=f"Folder for {holds}.",
        )
        return option(cast("F", holding))

    return added


def _command_name(context: click.Context) -> str:
    """Name of the command without the program's, which is `impc` or `python -m impc`."""
    names = list[str]()
    while context.parent is not None:
        names.insert(0, str(context.info_name))
        context = context.parent
    return " ".join(names)


def subject_arguments(config: str) -> Callable[[F], F]:
    """Add FILES and options of a fit, --config with the help `config`; passed on as `asked`."""
    path, words = click.Path(path_type=Path), ("files", "given", "allowed", "config", "solver")
    options = (
        click.argument("files", nargs=-1, type=path),
        code_options("plant", "configuration", f": {', '.join(KNOWN)}; your own module:function; "
                     "or a .mat, .npz or .json file with a state-space model"),
        click.option("--config", required=True, type=path, help=config),
        solver_option,
        yes_option,
    )  # fmt: skip

    def added(command: F) -> F:
        @functools.wraps(command)
        def asking(*given: Any, **named: Any) -> Any:
            from impc.files.formats import recognised  # noqa: PLC0415

            for file in named["files"]:  # before the libraries are loaded, which takes seconds
                recognised(file)
            name = _command_name(click.get_current_context())
            asked = asked_subject(name, **{word: named.pop(word) for word in words})
            return command(*given, asked=asked, **named)

        return functools.reduce(lambda found, one: one(found), options[::-1], cast("F", asking))

    return added


def scheduler_options(command: F) -> F:
    """Add --scheduler and --workers to a `command`."""
    options = (
        click.option(
            "--scheduler", help="Address of a running Dask scheduler, such as tls://host:8786."
        ),
        click.option(
            "--workers",
            type=click.IntRange(1, 1024),
            help="Number of workers on this machine; by default one per core.",
        ),
    )

    @functools.wraps(command)
    def connecting(*given: Any, scheduler: str | None, workers: int | None, **named: Any) -> Any:
        from impc.studies.scheduler import Cluster  # noqa: PLC0415

        return command(*given, cluster=Cluster(scheduler, workers), **named)

    return functools.reduce(lambda found, one: one(found), options[::-1], cast("F", connecting))


def code_options(kind: str, file: str = "study", names: str = "") -> Callable[[F], F]:
    """Add --plant and --allow-plant (or --model ...): consent to run code that a `file` names."""
    name = click.option(
        f"--{kind}", "given", help=f"Replaces the {kind} that the {file} names{names}."
    )
    allow = click.option(
        f"--allow-{kind}",
        "allowed",
        is_flag=True,
        help=f"Allow running the code that the {file} names as its {kind}.",
    )
    return lambda command: name(allow(command))


def study_options(kind: str, folder: str, holds: str) -> Callable[[F], F]:
    """Add STUDY, the options of the code that it names as its `kind`, and --out."""
    study = click.argument("study_file", metavar="STUDY", type=click.Path(path_type=Path))
    code, out = code_options(kind), out_option(folder, holds)
    return lambda command: study(code(out(command)))


class Number(click.FloatRange):
    """A finite number in a range; click itself accepts nan and inf in every range."""

    name = "number"

    def convert(self, value: Any, param: Parameter | None, ctx: Context | None) -> float:
        """Convert `value` to a float; `param` and `ctx` are for click's message."""
        found = float(super().convert(value, param, ctx))
        if not math.isfinite(found):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return found
