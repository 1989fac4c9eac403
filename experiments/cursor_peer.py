"""Fit the package `lqg` to people who follow a blurred target, scored as in `cursor_people`.

Straub and Rothkopf (eLife 11:e76635, 2022) infer costs and noise of linear-quadratic Gaussian
regulators. Their two models of tracking are fitted here by their own `conditional_moments` and
gains. The objective is the log-likelihood of the cursor given target and past, for the same halves
of the trials and the same samples. As in their work the target is shifted by 12 samples. All other
parameters are optimised to convergence, which their Adam steps do not reach, and so is an offset
from the target, which `lqg` does not have.

This needs the extra `bench`:

    python -m experiments.cursor_peer SubjectiveActor --out results/cursor-peer
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
from tqdm import tqdm

from experiments.cursor_data import Condition, data_file, read_conditions
from experiments.cursor_people import FIRST
from impc.reporting.writer import write_files

if TYPE_CHECKING:
    from collections.abc import Callable

    from impc.arrays import Array, IntArray

__all__ = ["PeerRow", "peer_half"]

# Delay of their data, samples; then starting noise SDs, pixels and pixels a second.
_DELAY = 12
_STARTS = {
    "BoundedActor": {
        "action_variability": 0.5,
        "sigma_target": 10.0,
        "sigma_cursor": 6.0,
        "action_cost": 1.0,
    },
    "SubjectiveActor": {
        "action_variability": 0.5,
        "subj_noise": 1.0,
        "subj_vel_noise": 2.0,
        "sigma_target": 10.0,
        "sigma_cursor": 6.0,
        "action_cost": 1.0,
    },
}
# Bound on the change of a logarithm; pixels for one unit of the search.
_FARTHEST, _PIXELS = 12.0, 3.0


@dataclass(frozen=True)
class PeerRow:
    """One half of a blur, evaluated on the other half: see `experiments.cursor_people`."""

    model: str
    blur: float
    half: int
    inside: float
    outside: float
    offset: float
    numbers: dict[str, float]
    evaluations: int


def peer_half(condition: Condition, half: int, model: str) -> PeerRow:
    """Fit one of their models to half of the trials and evaluate it on the other half."""
    every = np.arange(len(condition.target))
    parts = every[half::2], every[1 - half :: 2]
    jax = importlib.import_module("jax")
    jax.config.update("jax_enable_x64", True)
    mine, others = (_shifted(condition, part) for part in parts)
    steps = np.diff(condition.target[parts[0]], axis=1)
    likelihood = _identified(jax, model, float(np.std(steps)))
    slopes = jax.jit(jax.value_and_grad(lambda theta: -likelihood(theta, mine)))

    def objective(theta: Array) -> tuple[float, Array]:
        value, slope = slopes(theta)
        return float(value), np.asarray(slope, dtype=float)

    start = np.log([*_STARTS[model].values()])
    beside = np.mean((condition.response - condition.target)[parts[0], FIRST:])
    found = scipy.optimize.minimize(
        objective,
        np.append(start, beside / _PIXELS),
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_FARTHEST, _FARTHEST)] * (len(start) + 1),
        options={"maxiter": 150, "ftol": 1e-10},
    )
    return PeerRow(
        model,
        condition.blur,
        half,
        -float(found.fun),
        float(likelihood(found.x, others)),
        float(found.x[-1] * _PIXELS),
        dict(zip(_STARTS[model], np.exp(found.x[:-1]).tolist(), strict=True)),
        int(found.nfev),
    )


def _shifted(condition: Condition, which: IntArray) -> Array:
    """Target and cursor (trials, samples, 2), with the delay of the cursor removed."""
    target, response = condition.target[which], condition.response[which]
    return np.stack([target[:, :-_DELAY], response[:, _DELAY:]], axis=-1)


def _identified(jax: Any, model: str, steps: float) -> Callable[[Any, Array], Any]:
    """Mean log-likelihood of the cursor from sample FIRST on, at theta (q,)."""
    jnp = jax.numpy
    make = getattr(importlib.import_module("lqg.tracking"), model)
    names = list(_STARTS[model])

    def likelihood(theta: Any, trials: Array) -> Any:
        x = jnp.asarray(trials).at[:, :, 1].add(-_PIXELS * theta[-1])
        x = x - x[:, :1, :1]  # Their estimate starts at zero
        numbers = {name: jnp.exp(value) for name, value in zip(names, theta, strict=False)}
        person = make(process_noise=steps, T=x.shape[1] - 1, **numbers)
        mean, spread = jax.vmap(person.conditional_moments, in_axes=(0, None))(x, None)
        error = x[:, 1:] - mean[:, :, :2]
        # Distribution of the cursor given the target of that sample.
        slope = spread[:, :, 1, 0] / spread[:, :, 0, 0]
        left = error[:, :, 1] - slope * error[:, :, 0]
        variance = spread[:, :, 1, 1] - slope * spread[:, :, 1, 0]
        each = -(jnp.log(2 * jnp.pi * variance) + left**2 / variance) / 2
        return jnp.mean(each[:, FIRST - _DELAY - 1 :])

    return likelihood


def main() -> None:
    """Fit every half, print the mean of each blur, and write result.json."""
    parser = argparse.ArgumentParser(description="The package lqg on a blurred target.")
    parser.add_argument("model", choices=list(_STARTS))
    parser.add_argument("--out", type=Path, default=Path("results", "cursor-peer"))
    given = parser.parse_args()
    if not data_file().exists() or not importlib.util.find_spec("lqg"):
        print("The recordings or the package lqg (extra `bench`) are not there.")
        return
    jobs = [(one, half) for one in read_conditions(data_file()) for half in (0, 1)]
    rows = [peer_half(condition, half, given.model) for condition, half in tqdm(jobs)]
    print("| blur, px | nats a sample, even, odd trials held out | mean |\n|---|---|---|")
    for even, odd in zip(rows[::2], rows[1::2], strict=True):
        mean = (even.outside + odd.outside) / 2
        print(f"| {even.blur:.0f} | {odd.outside:.4f}, {even.outside:.4f} | {mean:.4f} |")
    print(f"| mean | | {np.mean([row.outside for row in rows]):.4f} |")
    numbers = json.dumps([asdict(row) for row in rows], indent=1).encode()
    write_files(given.out, {"result.json": numbers})


if __name__ == "__main__":
    main()
