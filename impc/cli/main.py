"""The `impc` program: dispatch to its commands and report failures in one line."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import click

from impc.cli import commands
from impc.cli.ending import ExitStatus, ended, interruptions, own_process
from impc.cli.simulate import command as simulate
from impc.jit import keep_caches, say_when_compiling
from impc.settings_files import ignore_settings_files

# Of a higher layer; imported only when it is used.
_APP = "app"


class _Program(click.Group):
    """Group of commands that ends every expected failure with one line on stderr."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted([_APP, *super().list_commands(ctx)])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name != _APP:
            return super().get_command(ctx, cmd_name)
        found: click.Command = importlib.import_module("impc.app.command").command
        return found

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with interruptions():
            return super().make_context(*args, **kwargs)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        # The matrices are small: more threads of linear algebra slow the program. Must be set
        # before numpy is imported; the user's own value is kept.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

        def work() -> Any:
            return click.Group.main(self, *args, **kwargs | {"standalone_mode": False})

        if args or kwargs:  # called from Python
            sys.exit(ended(work))
        with own_process():
            ignore_settings_files("matplotlib", "numba")
            note = keep_caches()
            say_when_compiling(lambda text: click.echo(f"impc: {text}", err=True))
            status = ended(work)
            if note and status == ExitStatus.DONE and "numba" in sys.modules:
                click.echo(f"impc: note: {note}", err=True)
        sys.exit(status)

    def invoke(self, ctx: click.Context) -> Any:
        # Here, because click's own handling prints an empty line first.
        with interruptions():
            return super().invoke(ctx)


# Every command below shows the defaults of its options.
@click.group(cls=_Program, invoke_without_command=True, context_settings={"show_default": True})
@click.version_option(package_name="impc", prog_name="impc")
@click.pass_context
def main(context: click.Context) -> None:
    """Inverse model predictive control: infer the controller behind recorded movements."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


for _command in vars(commands).values():
    if isinstance(_command, click.Command):
        main.add_command(_command)
main.add_command(simulate)
