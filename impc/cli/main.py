"""The `impc` program: dispatch to its commands and report failures in one line."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

import click

from impc.cli.ending import ExitStatus, ended, interruptions, own_process
from impc.jit import keep_caches, say_when_compiling
from impc.settings_files import ignore_settings_files

# Command -> module and function; imported only when the command is used.
_COMMANDS = {
    "app": ("impc.app.command", "command"),
    "cohort": ("impc.cli.cohort", "command"),
    "compare": ("impc.cli.fit", "compare_command"),
    "example": ("impc.cli.example", "command"),
    "fit": ("impc.cli.fit", "command"),
    "inspect": ("impc.cli.inspect", "command"),
    "key-parameters": ("impc.cli.select", "key_command"),
    "plan": ("impc.cli.plan", "command"),
    "reliability": ("impc.cli.cohort", "reliability_command"),
    "results": ("impc.cli.cohort", "results_command"),
    "select": ("impc.cli.select", "command"),
    "simulate": ("impc.cli.simulate", "command"),
    "warm": (__name__, "warm"),
}


class _Program(click.Group):
    """Group of commands that ends every expected failure with one line on stderr."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        module, function = _COMMANDS[cmd_name]
        found: click.Command = getattr(importlib.import_module(module), function)
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


@click.command("warm")
@click.option("--sensory-noise", is_flag=True, help="Also compile the filter of sensory noise.")
def warm(sensory_noise: bool) -> None:
    """Compile the inner loops of all commands once; takes about half a minute.

    `make demo` calls it; after an installation by pip, call it yourself. Without it, the first
    command that needs compiled code compiles it and says so. So does the first fit with sensory
    noise: its filter is compiled here only with --sensory-noise.
    """
    say_when_compiling(lambda _: None)  # this command prints its own lines
    from impc.studies.warm import compile_bodies, compile_filter, compile_loop  # noqa: PLC0415

    compile_loop()
    click.echo("compiled: the constrained controller and its closed loop")
    compile_bodies()
    click.echo("compiled: nonlinear bodies")
    if sensory_noise:
        compile_filter()
        click.echo("compiled: the filter of sensory noise")
