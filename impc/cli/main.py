"""The `impc` command: finds the subcommand asked for and turns its failure into one line."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import click

from impc.cli.ending import ExitStatus, ended, interruptions, own_process
from impc.jit import keep_caches, say_when_compiling
from impc.settings_files import ignore_settings_files

# One module a command, loaded when it is asked for: name -> module, which holds it as `command`.
_COMMANDS = {
    "cohort": "impc.cli.cohort",
    "compare": "impc.cli.compare",
    "example": "impc.cli.example",
    "fit": "impc.cli.fit",
    "inspect": "impc.cli.inspect",
    "key-parameters": "impc.cli.key_parameters",
    "plan": "impc.cli.plan",
    "reliability": "impc.cli.reliability",
    "select": "impc.cli.select",
    "simulate": "impc.cli.simulate",
    "warm": "impc.cli.warm",
}


class _Program(click.Group):
    """Ends every expected failure with one line on stderr: no usage text, no traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        module = _COMMANDS.get(cmd_name)
        if module is None:
            return None
        found: click.Command = importlib.import_module(module).command
        return found

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with interruptions():
            return super().make_context(*args, **kwargs)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        # Matrices of ten rows: a second thread of linear algebra costs more than it does. Before
        # numpy is imported, and only in this program; a value of the user's own stands.
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
    """Inverse model predictive control: the weights behind a recorded closed loop."""
    if context.invoked_subcommand is None:
        click.echo(context.get_help())
