"""The same work on every subject: here one after the other, or on workers.

Workers load the model by its import path; recordings travel with the task. What a task returned is
kept on disk under a digest of all that went into it, so that an interrupted command goes on.
"""

from __future__ import annotations

import functools
import json
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from impc.errors import ImpcError, InputError, SolverError
from impc.files.digests import digest, source_digest, versions
from impc.studies.cache import Cache, by_fields
from impc.studies.selection.model import Trial
from impc.studies.selection.model_source import model_source

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from impc.files.sealed import Kept
    from impc.studies.cohort.workers import Workers
    from impc.studies.selection.model import ParametricModel
    from impc.studies.selection.model_source import ModelSource

T = TypeVar("T")


class Runner(Protocol):
    """Does the same work for every name of a mapping."""

    def __call__(
        self, work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        """name -> work(model, *arguments), in the order of `arguments`; `kind` is its dataclass."""
        ...


def in_turn(model: ParametricModel) -> Runner:
    """One after the other, in this process; nothing is kept."""

    def run(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        return {name: work(model, *given) for name, given in arguments.items()}

    return run


def on_workers(
    workers: Workers, source: ModelSource, kept: Kept, done: Callable[[str], None] = lambda _: None
) -> Runner:
    """On workers; what is kept already is not done again."""

    def run(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        found: dict[str, T] = {}
        made_of = _made_of(source.name, source.arguments)
        cache, codec = Cache(kept, made_of), by_fields(kind)
        keys = {name: _digest(source, made_of, work, given) for name, given in arguments.items()}
        for name, given in arguments.items():
            if keys[name] in cache.stages:
                found[name] = codec.decode(cache.stages[keys[name]])
                done(name)
                continue
            workers.submit(
                name, _task, source.name, json.dumps(source.arguments), made_of, work, given
            )
        for item in workers.results() if len(found) < len(arguments) else ():
            name = str(item.key)
            if item.fault:
                raise SolverError(f"task {name}", item.fault, "see what its recording has")
            if isinstance(item.value, ImpcError):
                raise item.value
            found[name] = item.value
            cache.keep(keys[name], item.value, codec)
            done(name)
        return {name: found[name] for name in arguments}

    return run


def _task(
    name: str, arguments: str, made_of: str, work: Callable[..., Any], given: tuple[Any, ...]
) -> Any:
    """On a worker; a failure that has a sentence comes back as it is, without the worker's log."""
    try:
        return work(_model(name, arguments, made_of), *given)
    except ImpcError as error:
        return error


@functools.lru_cache(maxsize=4)
def _model(name: str, arguments: str, made_of: str) -> ParametricModel:
    source = model_source(name, json.loads(arguments))
    if _made_of(name, source.arguments) != made_of:
        raise InputError(
            "worker", "has another model or other versions than this command",
            "give all machines the same, and start the workers again",
        )  # fmt: skip
    return source.model


def _made_of(name: str, arguments: Mapping[str, Any]) -> str:
    return digest(versions(), source_digest(name, arguments), dict(arguments))


def _digest(
    source: ModelSource, made_of: str, work: Callable[..., Any], given: tuple[Any, ...]
) -> str:
    """Of the versions, the model's code and ranges, the work and its arguments.

    Of a model that computes with other files it is an output that tells.
    """
    model = source.model
    outputs = [
        model.simulate(np.array(model.typical), item[0].input)
        for item in given
        if isinstance(item, tuple) and item and isinstance(item[0], Trial)
    ]
    ranges = model.names, model.low, model.high, model.typical
    return digest(made_of, ranges, outputs, work.__module__, work.__qualname__, given)
