"""What a cohort will take, told before it is begun, from one of its units."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from impc.checking import replace
from impc.errors import ImpcError
from impc.studies.cohort.unit_task import unit_problem
from impc.studies.effort import Effort, fit_effort

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.studies.cohort.unit_task import FitTask


def study_effort(tasks: Mapping[str, FitTask]) -> tuple[Effort, float]:
    """What the first unit that can be read takes, and as how many such units all `tasks` count.

    Units are compared by the size of their files. A study no unit of which can be read takes
    nothing: it will end at once.
    """
    sizes = {
        name: sum(Path(file).stat().st_size for file in task.files) for name, task in tasks.items()
    }
    for name, task in tasks.items():
        try:
            problem, settings = unit_problem(task)
        except ImpcError:  # told as the unit's own when its turn comes
            continue
        alone = replace(settings, profiles=[], horizons=[], unknown_limit=False)
        return fit_effort(problem, alone), sum(sizes.values()) / max(sizes[name], 1)
    return Effort(0.0, 0.0), 0.0
