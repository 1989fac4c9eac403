"""`impc warm`: compile once what the other commands run."""

from __future__ import annotations

import importlib.util

import click

from impc.jit import say_when_compiling


@click.command("warm")
def command() -> None:
    """Compile what the other commands run, once: some minutes, after which none compiles.

    `make env` ends with it; after an installation by pip it is yours to call. Without it the first
    command compiles what it needs and says so.
    """
    say_when_compiling(lambda _: None)  # nobody has to be told here
    from impc.control.warm import compiled_parts  # noqa: PLC0415  # loads numba

    for part in compiled_parts():
        click.echo(f"compiled: {part}")
    if importlib.util.find_spec("impc.output_feedback"):
        from impc.output_feedback.warm import compile_filter  # noqa: PLC0415

        compile_filter()
        click.echo("compiled: subjects who sense with noise")
