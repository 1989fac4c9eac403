"""Load a model by import path, read the recordings, and run tasks on all subjects.

The function at the import path returns a mapping with

    names, low, high, typical       parameters: names, bounds, typical values
    pathways, units, meanings       optional, per parameter
    deviation                       optional: SD between people, per parameter
    inputs, outputs, rate           names of the signals in a recording; samples per second
    simulate                        (theta, input (samples, d)) -> outputs (samples, p), or
    matrices                        a CasADi function theta -> A, B, C (continuous time), which
                                    gives exact sensitivities
    jacobian                        optional with simulate: (theta, input, free) -> outputs,
                                    derivatives

Workers load the model by its import path; recordings are part of the task.
"""

from __future__ import annotations

import functools
import json
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from impc.errors import InputError
from impc.files.digests import digest, source_digest, versions
from impc.files.plant_sources import import_function, users_code
from impc.files.reading import read_recordings, require_whole
from impc.model.plant import Plant
from impc.studies.cache import Cache, from_json
from impc.studies.cohort.study import Study
from impc.studies.pool import Pool, Result, Task, run
from impc.studies.selection.model import (
    ParametricModel,
    Trial,
    linear_functions,
    parametric_model,
)

T = TypeVar("T")

_NEEDED = ("names", "low", "high", "typical", "inputs", "outputs", "rate")


@dataclass(frozen=True)
class ModelSource:
    """A model and the names of its signals in recordings."""

    name: str  # Import path of the function
    arguments: Mapping[str, Any]  # Arguments of the function
    model: ParametricModel
    inputs: tuple[str, ...]  # Names of signals
    outputs: tuple[str, ...]
    rate: float  # Samples per second of the model


def model_source(name: str, arguments: Mapping[str, Any]) -> ModelSource:
    """Call the function of an import path `name`, ``module:function``, with arguments."""
    make = import_function(name)
    try:
        with users_code(f"model {name}", TypeError, ValueError):
            returned = make(**arguments)
    except (TypeError, ValueError) as error:
        raise InputError(f"model {name}", str(error), "correct the [model] table") from None
    lacking = [key for key in _NEEDED if not isinstance(returned, dict) or key not in returned]
    if lacking or not ("matrices" in returned or "simulate" in returned):
        missing = lacking[0] if lacking else "simulate or matrices"
        raise InputError(
            f"model {name}", f"lacks {missing}", "see docs/howto/reliability_selection.md"
        )
    rate = float(returned["rate"])
    simulate, jacobian = returned.get("simulate"), returned.get("jacobian")
    if "matrices" in returned:
        simulate, jacobian = linear_functions(returned["matrices"], 1 / rate)
    names, low, high, typical = (returned[key] for key in _NEEDED[:4])
    said = {key: returned.get(key) for key in ("pathways", "units", "meanings", "deviation")}
    model = parametric_model(names, low, high, typical, simulate, jacobian=jacobian, **said)
    return ModelSource(
        name, dict(arguments), model, tuple(returned["inputs"]), tuple(returned["outputs"]), rate
    )


def read_trials(study: Study, source: ModelSource) -> dict[tuple[str, str], tuple[Trial, ...]]:
    """Trials of every subject and visit, over all conditions."""
    import control  # noqa: PLC0415  # takes a second

    # A dummy plant: the reader takes the names of signals and the rate from it.
    d, p = len(source.inputs), len(source.outputs)
    names: dict[str, Any] = {"inputs": ["nothing", *source.inputs], "outputs": source.outputs}
    system = control.ss([[0.5]], np.ones((1, 1 + d)), np.ones((p, 1)), 0, 1 / source.rate, **names)
    plant = Plant(system, ["nothing"])
    found: dict[tuple[str, str], tuple[Trial, ...]] = {}
    for unit in study.units:
        trials = read_recordings(unit.files, study.configuration, plant)
        require_whole(trials, "select")
        key = (unit.subject, unit.visit)
        found[key] = found.get(key, ()) + tuple(
            Trial(item.disturbance, item.outputs) for item in trials
        )
    return found


class Runner(Protocol):
    """Runs the same function for all entries of a mapping."""

    def __call__(
        self, work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        """Return name -> work(model, *arguments), a dataclass `kind`, in the given order."""
        ...


def on_pool(
    pool: Pool, source: ModelSource, cache: Cache, done: Callable[[Result], None] = lambda _: None
) -> Runner:
    """Runner on the workers of a pool."""
    made_of = _made_of(source.name, source.arguments)
    named = source.name, json.dumps(source.arguments), made_of

    def run_all(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        found = dict[str, T]()
        queue = deque[Task]()
        for name, given in arguments.items():
            key = digest(made_of, work.__module__, work.__qualname__, given)
            queue.append(Task(f"{work.__name__} {name}", key, _with_model, (*named, work, given)))
        for result in run(pool, queue, cache):
            name = result.task.name.removeprefix(f"{work.__name__} ")
            if result.fault is not None:
                fault = result.fault
                raise type(fault)(f"{name}: {fault.subject}", fault.problem, fault.remedy)
            found[name] = from_json(result.content, kind)
            done(result)
        return {name: found[name] for name in arguments}

    return run_all


def _with_model(
    name: str, arguments: str, made_of: str, work: Callable[..., Any], given: tuple[Any, ...]
) -> Any:
    return work(_model(name, arguments, made_of), *given)


@functools.lru_cache(maxsize=4)
def _model(name: str, arguments: str, made_of: str) -> ParametricModel:
    source = model_source(name, json.loads(arguments))
    if _made_of(name, source.arguments) != made_of:
        raise InputError(
            "worker", "has another model or other versions than this command",
            "copy the same files and versions to all machines, and restart the workers",
        )  # fmt: skip
    return source.model


def _made_of(name: str, arguments: Mapping[str, Any]) -> str:
    return digest(versions(), source_digest(name, arguments), dict(arguments))
