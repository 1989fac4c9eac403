"""Driver of the studies: noise of simulated recordings, processes, and results that are kept.

A study is a function of a task, for example of a seed, that simulates a subject, fits it, and
returns what is counted. `each` computes tasks in two processes. `kept_rows` also appends a line of
JSON for each task to a file and computes no task twice, so a study can be interrupted, continued
and summarised.
"""

from __future__ import annotations

import functools
import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy.signal
from tqdm import tqdm

from impc.arrays import Array
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.feasibility import require_complete
from impc.control.simulation import scenario
from impc.model.recordings import Recording

__all__ = ["Row", "each", "first_order_noise", "kept_rows", "noisy", "with_noise"]

Row = dict[str, Any]
Task = TypeVar("Task")
Found = TypeVar("Found")


def first_order_noise(
    rng: np.random.Generator, shape: tuple[int, ...], root: float, before: int = 500
) -> Array:
    """Noise of variance one (samples, p) with coefficient `root`, after `before` samples."""
    white = rng.standard_normal((shape[0] + before, *shape[1:]))
    found = scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)
    return np.asarray(found[before:])


def noisy(clean: Array, ratio: float, noise: Array) -> Array:
    """`clean` (samples, p) with noise of `ratio` times its power; `noise` has variance one."""
    return np.asarray(clean + np.sqrt(ratio * np.mean(clean**2, axis=0)) * noise)


def with_noise(
    controller: Controller, push: Array, rng: np.random.Generator, vaf: float, root: float
) -> Recording:
    """Simulate the controller under a disturbance and add noise to its outputs."""
    plant, samples = controller.plant, len(push)
    run = simulate(controller, scenario(plant, np.zeros(plant.n), disturbance=push))
    clean = (require_complete(controller, run).x @ plant.C.T)[:samples]
    outputs = noisy(clean, (100 - vaf) / vaf, first_order_noise(rng, clean.shape, root))
    return Recording(plant, outputs, push)


def each(function: Callable[[Task], Found], tasks: Sequence[Task]) -> list[Found]:
    """Results of a function for all tasks, in their order."""
    return list(_computed(function, tasks))


def kept_rows(
    path: Path, function: Callable[..., Row], tasks: Iterable[tuple[str, int]]
) -> dict[str, list[Row]]:
    """Rows of a file by study, after `function(study, seed)` of the tasks that it does not have."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    done = {(row["study"], row["seed"]) for row in rows}
    left = [task for task in tasks if task not in done]
    with path.open("a", encoding="utf-8") as file:
        for (study, seed), found in zip(
            left, _computed(functools.partial(_called, function), left), strict=True
        ):
            rows.append({"study": study, "seed": seed, **found})
            file.write(json.dumps(rows[-1]) + "\n")
            file.flush()
    by_study: dict[str, list[Row]] = {}
    for row in rows:
        by_study.setdefault(row["study"], []).append(row)
    return by_study


def _called(function: Callable[..., Row], task: tuple[str, int]) -> Row:
    return function(*task)


def _computed(function: Callable[[Task], Found], tasks: Sequence[Task]) -> Iterator[Found]:
    # A fork of a process with threads may hang, and Python 3.12 warns of it.
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        try:
            yield from tqdm(pool.map(function, tasks), total=len(tasks), disable=None)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
