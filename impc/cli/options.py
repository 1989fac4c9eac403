"""Options that several commands have alike.

Numbers as options: click lets nan and infinity through every range.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click

from impc.cli.plant import KNOWN

if TYPE_CHECKING:
    from collections.abc import Callable

    from click import Context, Parameter

F = TypeVar("F", bound="Callable[..., Any]")

#: Numbers drawn for trial k of a seed follow from 100 seed + k, which has to be one of 64 bits.
LARGEST_SEED = 10**15

#: --seed of everything that is simulated.
seed_option = click.option(
    "--seed",
    type=click.IntRange(0, LARGEST_SEED),
    default=0,
    help="All numbers drawn follow from it.",
)

#: --solver; the names are those of `impc.control.named_solver`, which is not loaded for --help.
solver_option = click.option(
    "--solver",
    help="What solves the controller's quadratic programs: compiled (the package's own, and the "
    "default), or daqp, qpoases or ipopt of CasADi. Of an optimal control problem of your own: "
    "ipopt, sqpmethod or fatrop.",
)

#: --yes of what may take hours, see `impc.cli.console`.
yes_option = click.option(
    "--yes", is_flag=True, help="Do not ask before what takes hours or much memory."
)


def page_options(command: F) -> F:
    """Add --pdf and --open to a `command` that writes a page."""
    pdf = click.option("--pdf", is_flag=True, help="Write the figures as PDF too.")
    shown = click.option("--open", "open_page", is_flag=True, help="Open the page in the browser.")
    return pdf(shown(command))


def out_option(folder: str, holds: str) -> Callable[[F], F]:
    """--out: a `folder` inside results/ by default; its help says what it `holds`.

    The command holds its folder while it runs, and owns what it wrote there (`owned`).
    """

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
    """Without the program's own, which is `impc` or `python -m impc` for the same command."""
    names = list[str]()
    while context.parent is not None:
        names.insert(0, str(context.info_name))
        context = context.parent
    return " ".join(names)


def subject_arguments(config: str) -> Callable[[F], F]:
    """FILES, --plant and --config of one subject, of the help `config`; --solver and --yes."""
    options = (
        click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path)),
        click.option(
            "--plant",
            "plant_name",
            required=True,
            help=f"{', '.join(KNOWN)}; module:function of your own; or a .mat, .npz or .json state "
            "space.",
        ),
        click.option("--config", required=True, type=click.Path(path_type=Path), help=config),
        solver_option,
        yes_option,
    )
    return lambda command: functools.reduce(lambda found, one: one(found), options[::-1], command)


def scheduler_options(command: F) -> F:
    """Add --scheduler, its certificates, and --workers to a `command`."""
    path = click.Path(path_type=Path)
    options = (
        click.option(
            "--scheduler", help="Address of a running Dask scheduler, such as tls://host:8786."
        ),
        click.option("--tls-ca", type=path, help="Certificate of whoever signed the scheduler's."),
        click.option("--tls-cert", type=path, help="Certificate to show to the scheduler."),
        click.option("--tls-key", type=path, help="Its private key."),
        click.option(
            "--workers",
            type=click.IntRange(1, 1024),
            help="Workers on this machine; one a core by default.",
        ),
    )

    @functools.wraps(command)
    def connecting(
        *given: Any,
        scheduler: str | None,
        tls_ca: Path | None,
        tls_cert: Path | None,
        tls_key: Path | None,
        workers: int | None,
        **named: Any,
    ) -> Any:
        from impc.studies.scheduler import Cluster  # noqa: PLC0415

        cluster = Cluster(scheduler, workers, tls_ca, tls_cert, tls_key)
        return command(*given, cluster=cluster, **named)

    return functools.reduce(lambda found, one: one(found), options[::-1], cast("F", connecting))


def code_options(kind: str) -> Callable[[F], F]:
    """--plant and --allow-plant, or --model and --allow-model: consent to run what a file names."""
    name = click.option(
        f"--{kind}", f"{kind}_name", help=f"The {kind}, in place of the one that the study names."
    )
    allow = click.option(
        f"--allow-{kind}",
        "allowed",
        is_flag=True,
        help=f"Run the code that the study names as its {kind}.",
    )
    return lambda command: name(allow(command))


class Number(click.FloatRange):
    """A number between two others; `nan` and `inf` are none."""

    name = "number"

    def convert(self, value: Any, param: Parameter | None, ctx: Context | None) -> float:
        """The number that `value` says; click gives `param` and `ctx` for its message."""
        found = float(super().convert(value, param, ctx))
        if not math.isfinite(found):
            self.fail(f"{value} is no number to compute with.", param, ctx)
        return found
