"""Before a request that would take hours, or most of a machine's memory, is begun."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from impc.studies.effort import Effort

# What is begun without a question: two hours, and what a machine of 8 GB has to spare.
_SECONDS, _GIGABYTES = 7200.0, 4.0


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
    if given or (effort.seconds <= _SECONDS and effort.gigabytes <= _GIGABYTES):
        return
    takes = f"would take about {effort.seconds / 3600:.3g} hours"
    problem = needs if effort.seconds <= _SECONDS else takes
    asked = sys.stdin is not None and sys.stdin.isatty()
    if asked and click.confirm(f"impc: this request {problem}; go on?", err=True):
        return
    raise InputError("this request", problem, f"{lower}; or say --yes")
