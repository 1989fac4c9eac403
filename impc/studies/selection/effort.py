"""What a selection will take, told before it is begun: evaluations of the model, seconds, memory.

The model is the user's: what one evaluation takes is measured. How many there will be is told from
the settings, to its order of magnitude: a fit takes from 7 to 200 (docs/speed.md).
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from impc.studies.effort import Effort
from impc.studies.selection.model import sensitivity

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from impc.studies.selection.model import ParametricModel, Trial
    from impc.studies.selection.settings import SelectSettings

# Evaluations with derivatives of a fit from a start far off, of one from its neighbourhood, of a
# LASSO with its refit, and of Table C.1 (of the outputs alone: a few thousand a solve). Counted
# on the drug: 7, 5, 74; on the head, whose twelve parameters are hardly told: 200, 17, 23.
_FIT, _REFIT, _LASSO, _TABLE = 30, 9, 100, 4000
# Arrays of the size of the derivative that a fit holds, and fits at a time in a bootstrap.
_COPIES, _THREADS = 6, 2


def select_evaluations(settings: SelectSettings) -> int:
    """Of the model with its derivative, for one subject of `impc select`."""
    table = _TABLE if settings.nelder_mead else 0
    return _FIT * settings.starts + _REFIT * settings.replicates + _LASSO + table


def key_evaluations(settings: SelectSettings, most: int = 20) -> int:
    """Of the model with its derivative, for one subject and visit of `impc key-parameters`."""
    return _FIT * (settings.starts + most)


def selection_effort(
    model: ParametricModel, recorded: Iterable[Sequence[Trial]], evaluations: int
) -> Effort:
    """What one subject takes, on average; the model is called three times."""
    subjects = [tuple(trials) for trials in recorded]
    samples = [sum(len(trial.input) for trial in trials) for trials in subjects]
    first = subjects[0][0]
    # The first call compiles, or loads, what the model needs: it took 300 times as long.
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        outputs, _slopes = sensitivity(model, np.array(model.typical), first.input)
        times.append(time.perf_counter() - begun)
    one = min(times) / len(first.input)
    numbers = max(samples) * outputs.shape[1] * model.size * _COPIES * _THREADS
    return Effort(one * float(np.mean(samples)) * evaluations, 8e-9 * numbers)
