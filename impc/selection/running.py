"""The same work on every subject: here one after the other, or on the workers of a scheduler.

Workers load the model by its import path; recordings travel with the task. What a task returned is
kept on disk under a digest of all that went into it, so that an interrupted command goes on.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import os
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import distributed
import msgspec
import numpy as np

from impc.arrays import frozen
from impc.errors import ImpcError, OutputError
from impc.selection.model import Trial
from impc.selection.source import model_source

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from distributed import Client

    from impc.selection.model import ParametricModel
    from impc.selection.source import ModelSource

__all__ = ["Kept", "Runner", "in_turn", "on_workers"]

T = TypeVar("T")


class Runner(Protocol):
    """Does the same work for every name of a mapping."""

    def __call__(
        self, work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        """name -> work(model, *arguments), in the order of `arguments`; `kind` is its dataclass."""
        ...


@dataclass(frozen=True)
class Kept:
    """Results of tasks in a folder, one file each.

    Attributes
    ----------
    folder : Path
        Made when the first result is kept.
    """

    folder: Path

    def find(self, key: str, kind: type[T]) -> T | None:
        """What was kept under a key, of that `kind`; None when nothing was, or it is damaged."""
        try:
            content = (self.folder / key).read_bytes()
            return msgspec.msgpack.decode(content, type=kind, dec_hook=_array)
        except (OSError, msgspec.DecodeError):
            return None

    def keep(self, key: str, value: object) -> None:
        """Write the result `value` down under a `key`.

        Raises
        ------
        OutputError
            When that cannot be done.
        """
        staging = self.folder / f"{key}.part"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            staging.write_bytes(msgspec.msgpack.encode(value, enc_hook=np.ndarray.tolist))
            os.replace(staging, self.folder / key)
        except OSError as error:
            raise OutputError(
                f"folder {self.folder}",
                f"cannot be written to ({error.strerror})",
                "give another folder",
            ) from None

    def forget(self) -> None:
        """Remove the folder: the final results have been written."""
        shutil.rmtree(self.folder, ignore_errors=True)


def in_turn(model: ParametricModel) -> Runner:
    """One after the other, in this process; nothing is kept."""

    def run(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        return {name: work(model, *given) for name, given in arguments.items()}

    return run


def on_workers(
    client: Client,
    source: ModelSource,
    kept: Kept,
    done: Callable[[str], None] = lambda _: None,
) -> Runner:
    """On the workers of a scheduler; what is kept already is not done again.

    Parameters
    ----------
    client : distributed.Client
        Of the scheduler.
    source : ModelSource
        Its import path must be known to the workers too.
    kept : Kept
    done : callable
        Told each name when its work is done.
    """

    def run(
        work: Callable[..., T], kind: type[T], arguments: Mapping[str, tuple[Any, ...]]
    ) -> dict[str, T]:
        found: dict[str, T] = {}
        keys = {name: _digest(source, work, given) for name, given in arguments.items()}
        out: dict[Any, str] = {}
        for name, given in arguments.items():
            before = kept.find(keys[name], kind)
            if before is not None:
                found[name] = before
                done(name)
                continue
            future = client.submit(
                _task, source.name, json.dumps(source.arguments), work, given, pure=False
            )
            out[future] = name
        make: Any = distributed.as_completed  # distributed types few of its functions
        for future in make(list(out)) if out else ():
            result = future.result()
            if isinstance(result, ImpcError):
                raise result
            found[out[future]] = result
            kept.keep(keys[out[future]], result)
            done(out[future])
        return {name: found[name] for name in arguments}

    return run


def _task(name: str, arguments: str, work: Callable[..., Any], given: tuple[Any, ...]) -> Any:
    """On a worker; a failure that has a sentence comes back as it is, without the worker's log."""
    try:
        return work(_model(name, arguments), *given)
    except ImpcError as error:
        return error


@functools.lru_cache(maxsize=4)
def _model(name: str, arguments: str) -> ParametricModel:
    return model_source(name, json.loads(arguments)).model


def _digest(source: ModelSource, work: Callable[..., Any], given: tuple[Any, ...]) -> str:
    """Of the package, the model (by name, ranges and an output), the work and its arguments."""
    model = source.model
    text = hashlib.sha256()
    named = importlib.metadata.version("impc"), source.name, source.arguments, model.names
    text.update(repr((*named, work.__module__, work.__qualname__)).encode())
    for values in (model.low, model.high, model.typical):
        text.update(np.ascontiguousarray(values).tobytes())
    for item in given:
        trials = item if isinstance(item, tuple) else ()
        for trial in trials:
            if isinstance(trial, Trial):
                text.update(np.ascontiguousarray(trial.input).tobytes())
                text.update(np.ascontiguousarray(trial.outputs).tobytes())
        if trials and isinstance(trials[0], Trial):
            outputs = model.simulate(np.array(model.typical), trials[0].input)
            text.update(np.ascontiguousarray(outputs).tobytes())
        else:
            text.update(repr(item).encode())
    return text.hexdigest()


def _array(kind: type, value: Any) -> Any:
    return frozen(value)
