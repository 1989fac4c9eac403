"""A small study for tests: unstable carts, each fitted in 0.1 s."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import control
import numpy as np

import impc
from experiments.coverage import cart
from tests.support import regulator

__all__ = ["cart_plant", "subject_trial", "write_study"]

_SAMPLES, _DT = 600, 0.05


def cart_plant(drag: float = 0.3) -> Any:
    """The plant of `experiments.coverage.cart` as the command takes it."""
    A, B = [[0.0, 1.0], [0.5, -drag]], [[0.0, 0.0], [1.0, 1.0]]
    names: dict[str, Any] = {"inputs": ["force", "push"], "outputs": ["position"]}
    return control.c2d(control.ss(A, B, [[1.0, 0.0]], 0, **names), _DT)


def subject_trial(seed: int, cost_weight: float = 4.0) -> impc.Recording:
    """A trial of a subject with Q = diag(cost weight, 1), with white noise of a fifth."""
    law, rng = regulator(cart(), np.diag([cost_weight, 1.0]), 1, 10), np.random.default_rng(seed)
    push = np.repeat(rng.choice([-0.8, 0.0, 0.8], _SAMPLES // 10), 10)
    run = impc.require_complete(law, law.simulate([0.0, 0.0], disturbance=push))
    clean = run.outputs[:_SAMPLES]
    noise = 0.2 * np.sqrt(np.mean(clean**2)) * rng.standard_normal(clean.shape)
    return impc.Recording(law.plant, clean + noise, push)


def write_study(
    folder: Path, subjects: int, visits: int = 1, replicates: int = 0, seed: int = 0
) -> Path:
    """Write a study with one trial per visit; return the path of study.toml."""
    rng = np.random.default_rng(seed)
    people = ["subject,group,drag,age"]
    for number in range(1, subjects + 1):
        group = "a" if number <= subjects / 2 else "b"
        people.append(f"{number:02d},{group},0.3,{20 + number}")
        cost_weight = (4.0 if group == "a" else 8.0) * float(np.exp(0.1 * rng.standard_normal()))
        for visit in range(1, visits + 1):
            trial = subject_trial(int(rng.integers(2**31)), cost_weight)
            rows = np.column_stack([np.arange(_SAMPLES) * _DT, trial.outputs, trial.disturbance])
            path = folder / f"sub-{number:02d}" / f"cart_{visit}.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(path, rows, delimiter=",", header="time,position,push", comments="")
    (folder / "people.csv").write_text("\n".join(people) + "\n")
    text = f"""\
[study]
plant = "tests.studies.cohort.carts:cart_plant"
recordings = "sub-{{subject}}/cart_{{visit}}.csv"
participants = "people.csv"
[recording]
time = "time"
[signals.position]
column = "position"
unit = "m"
[signals.push]
column = "push"
unit = "N"
[fit]
horizon = 10
u_max = 1.0
held_out = false
replicates = {replicates}
"""
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"
