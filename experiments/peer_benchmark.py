"""Nonlinear inverse MPC on the four systems of Safe-PDP: tables of experiments/nonlinear.md.

    python -m experiments.peer_benchmark starts     ten starts 10 % and ten 30 % off, one plan each
    python -m experiments.peer_benchmark loops      receding horizon: 60 samples, horizon 20
    python -m experiments.peer_benchmark noise      coverage of intervals at 20 dB on the robot arm

A start is truth * exp(S normal), seeds 0 to 9 (Jin, Mou and Pappas, NeurIPS 2021).
"""

from __future__ import annotations

import argparse
import functools
import itertools
import time
from typing import NamedTuple

import numpy as np

from experiments.driver import each
from experiments.peer_systems import SYSTEMS, PeerSystem
from experiments.summary import counted, markdown
from impc.arrays import Array
from impc.errors import ImpcError
from impc.nonlinear.closed_loop import OptimalRecording
from impc.nonlinear.combinations import Combination
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.plan import SOLVERS

__all__ = ["LOOPS", "Outcome", "coverage", "demonstration", "fit_from"]

#: Closed loops: initial state, and changes of the true parameters so that limits of states and of
#: inputs are both reached.
LOOPS: dict[str, tuple[list[float], dict[str, float]]] = {
    "cart-pole": ([0.0, 0.0, 0.0, 0.0], {}),
    "robot arm": ([-1.5, 1.5, 0.0, 0.0], {"max_q": 1.6, "wdq1": 0.02, "wdq2": 0.02}),
}


class Outcome(NamedTuple):
    """Result of one search."""

    loss: float  # Sum of squares over states and inputs; NaN without a plan at the start
    error: float  # Largest relative error of an identified product of parameters
    evaluations: int
    seconds: float  # CPU time, s
    unidentified: str  # Unidentified combinations


def demonstration(system: PeerSystem) -> OptimalRecording:
    """Recording of the plan at the true parameters, without noise."""
    plan = system.problem.plan(system.truth, system.x0, mu=1e-12)
    return system.problem.recorded_plan(plan.x, plan.u)


def fit_from(
    system: PeerSystem,
    recording: OptimalRecording,
    truth: dict[str, float],
    S: float,
    seed: int,
    solver: str = "ipopt",
) -> Outcome:
    """Search from truth * exp(S normal)."""
    factors = np.exp(S * np.random.default_rng(seed).normal(size=len(truth)))
    start = {
        name: value * factor for (name, value), factor in zip(truth.items(), factors, strict=True)
    }
    began = time.process_time()
    try:
        found = fit_optimal_control(system.problem, [recording], start, solver=solver)
    except ImpcError as error:
        return Outcome(np.nan, np.nan, 0, time.process_time() - began, str(error))
    seconds = time.process_time() - began
    unidentified = ", ".join(one.name for one in found.combinations.unidentified) or "none"
    products = found.combinations.identified
    wrong = max(abs(one.value / _product(truth, one) - 1) for one in products)
    return Outcome(found.loss, wrong, found.evaluations, seconds, unidentified)


def _product(truth: dict[str, float], one: Combination) -> float:
    return float(np.prod([truth[name] ** power for name, power in one.exponents.items()]))


def coverage(repetitions: int, decibel: float = 20.0) -> tuple[dict[str, list[bool]], list[str]]:
    """Whether 95 % intervals cover, by identified product, on the noisy robot arm.

    The noise on states and inputs is `decibel` below the root mean square of each signal. The
    initial state is known, and the search starts at the truth. The second result lists repetitions
    with other unidentified directions.
    """
    held: dict[str, list[bool]] = {}
    found = each(functools.partial(_covered, share=10 ** (-decibel / 20)), range(repetitions))
    for name, inside in itertools.chain(*(one for one, _ in found)):
        held.setdefault(name, []).append(inside)
    return held, [odd for _, odd in found if odd]


def _covered(seed: int, share: float) -> tuple[list[tuple[str, bool]], str]:
    """Identified products of one repetition, and other unidentified directions than usual."""
    system = SYSTEMS["robot arm"]()
    clean, rng = demonstration(system), np.random.default_rng([20, seed])
    noisy = [_noisy(item, share, rng) for item in (clean.x, clean.u)]
    recording = system.problem.recorded_plan(*noisy, x0=system.x0)
    found = fit_optimal_control(system.problem, [recording], system.truth).combinations
    held = []
    for one in found.identified:
        error = np.log(one.value / _product(system.truth, one))
        held.append((one.name, bool(abs(error) < 1.96 * one.deviation)))
    return held, "; ".join(found.sentences[:-1]) if len(found.unidentified) != 2 else ""


def _noisy(values: Array, share: float, rng: np.random.Generator) -> Array:
    size = np.sqrt(np.mean(values**2, axis=0))
    return np.asarray(values + share * size * rng.normal(size=values.shape))


def _start(task: tuple[str, float, int]) -> Outcome:
    name, S, seed = task
    system = SYSTEMS[name]()
    return fit_from(system, demonstration(system), system.truth, S, seed)


def _starts(systems: list[str], count: int) -> None:
    tasks = list(itertools.product(systems, (0.1, 0.3), range(count)))
    found = dict(zip(tasks, each(_start, tasks), strict=True))
    rows = []
    for name, S in itertools.product(systems, (0.1, 0.3)):
        outcomes = [found[name, S, seed] for seed in range(count)]
        good = [one for one in outcomes if one.loss < 1e-10]
        seconds = [one.seconds for one in good]
        rows.append([
            name, f"{S:g}", f"{len(good)} of {count}",
            f"{max((one.loss for one in good), default=np.nan):.1e}",
            f"{max((one.error for one in good), default=np.nan):.1e}",
            f"{np.median([one.evaluations for one in good]):.0f}",
            f"{np.median(seconds):.2f} ({max(seconds, default=np.nan):.2f})",
            " or ".join(sorted({one.unidentified for one in good})),
        ])  # fmt: skip
        for seed, one in enumerate(outcomes):
            if not one.loss < 1e-10:
                print(f"{name}, S {S:g}, seed {seed}: loss {one.loss:.3g}; {one.unidentified}")
    head = "system,S,loss below 1e-10,largest loss,largest error,evaluations,CPU s,not identified"
    print(markdown(head.split(","), rows))


def _loop(task: tuple[str, int], solver: str) -> Outcome:
    name, seed = task
    x0, changes = LOOPS[name]
    system = SYSTEMS[name](20)
    truth = system.truth | changes
    loop = system.problem.closed_loop(truth, x0, 60, mu=1e-12)
    recording = system.problem.recorded_loop(loop.x, loop.u)
    return fit_from(system, recording, truth, 0.1, seed, solver)


def _loops(systems: list[str], count: int, solver: str) -> None:
    tasks = [(name, seed) for name in LOOPS if name in systems for seed in range(count)]
    found = each(functools.partial(_loop, solver=solver), tasks)
    rows = [
        [name, solver, f"{seed}", f"{one.loss:.1e}", f"{one.error:.1e}", f"{one.evaluations}",
         f"{one.seconds:.1f}", one.unidentified]
        for (name, seed), one in zip(tasks, found, strict=True)
    ]  # fmt: skip
    head = "system,solver,seed,loss,largest error,evaluations,CPU s,not identified"
    print(markdown(head.split(","), rows))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Nonlinear inverse MPC on four systems.")
    parser.add_argument("study", choices=["starts", "loops", "noise"])
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument("--count", type=int, default=10, help="starts, or tens of repetitions")
    parser.add_argument("--solver", default="ipopt", choices=SOLVERS, help="for `loops`")
    given = parser.parse_args()
    if given.study == "starts":
        _starts(given.systems, given.count)
    elif given.study == "loops":
        _loops(given.systems, given.count, given.solver)
    else:
        held, odd = coverage(10 * given.count)
        for name, item in (*held.items(), ("all", list(itertools.chain(*held.values())))):
            print(f"{name}: {counted(sum(item), len(item))}")
        print(f"another direction is not identified in {len(odd)}:", *odd, sep="\n")


if __name__ == "__main__":
    main()
