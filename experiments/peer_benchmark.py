"""Nonlinear inverse MPC on the four systems of Safe-PDP: tables of experiments/nonlinear.md.

    python -m experiments.peer_benchmark starts     ten starts 10 % and ten 30 % off, one plan each
    python -m experiments.peer_benchmark loops      receding horizon: 60 samples, horizon 20
    python -m experiments.peer_benchmark noise      coverage of intervals at 20 dB on the robot arm

A start is truth * exp(S normal), seeds 0 to 9 (Jin, Mou and Pappas, NeurIPS 2021).
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from experiments.peer_systems import SYSTEMS
from impc.errors import ImpcError
from impc.nonlinear.fit import fit_optimal_control
from impc.nonlinear.plan import SOLVERS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from experiments.peer_systems import PeerSystem
    from impc.arrays import Array
    from impc.nonlinear.closed_loop import OptimalRecording
    from impc.nonlinear.combinations import Combination, Combinations

__all__ = ["LOOPS", "Outcome", "coverage", "demonstration", "fit_from", "identified_error"]

#: Closed loops: initial state, and changes of the true parameters so that limits of states and of
#: inputs are both reached.
LOOPS: dict[str, tuple[list[float], dict[str, float]]] = {
    "cart-pole": ([0.0, 0.0, 0.0, 0.0], {}),
    "robot arm": ([-1.5, 1.5, 0.0, 0.0], {"max_q": 1.6, "wdq1": 0.02, "wdq2": 0.02}),
}


@dataclass(frozen=True)
class Outcome:
    """Result of one search.

    Attributes
    ----------
    loss : float
        Sum of squares over states and inputs; NaN without a plan at the start.
    error : float
        Largest relative error of an identified product of parameters.
    evaluations : int
    seconds : float
        CPU time, s.
    unidentified : str
        Unidentified combinations.
    """

    loss: float
    error: float
    evaluations: int
    seconds: float
    unidentified: str


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
    wrong = identified_error(found.combinations, truth)
    return Outcome(found.loss, wrong, found.evaluations, seconds, unidentified)


def identified_error(found: Combinations, truth: dict[str, float]) -> float:
    """Largest relative error of the identified products."""
    errors = [abs(one.value / _product(truth, one) - 1) for one in found.identified]
    return max(errors)


def _product(truth: dict[str, float], one: Combination) -> float:
    return float(np.prod([truth[name] ** power for name, power in one.exponents.items()]))


def coverage(repetitions: int, decibel: float = 20.0) -> tuple[dict[str, list[bool]], list[str]]:
    """Whether 95 % intervals cover, by identified product, on the noisy robot arm.

    The noise on states and inputs is `decibel` below the root mean square of each signal. The
    initial state is known, and the search starts at the truth. The second result lists repetitions
    with other unidentified directions.
    """
    system = SYSTEMS["robot arm"]()
    clean = demonstration(system)
    share = 10 ** (-decibel / 20)
    held: dict[str, list[bool]] = {}
    odd: list[str] = []
    for seed in tqdm(range(repetitions), unit="repetition", disable=None):
        rng = np.random.default_rng([20, seed])
        noisy = [_noisy(item, share, rng) for item in (clean.x, clean.u)]
        recording = system.problem.recorded_plan(*noisy, x0=system.x0)
        found = fit_optimal_control(system.problem, [recording], system.truth).combinations
        for one in found.identified:
            expected = _product(system.truth, one)
            inside = abs(np.log(one.value / expected)) < 1.96 * one.deviation
            held.setdefault(one.name, []).append(bool(inside))
        if len(found.unidentified) != 2:
            odd.append("; ".join(found.sentences[:-1]))
    return held, odd


def _noisy(values: Array, share: float, rng: np.random.Generator) -> Array:
    size = np.sqrt(np.mean(values**2, axis=0))
    return np.asarray(values + share * size * rng.normal(size=values.shape))


def _line(name: str, S: float, outcomes: list[Outcome]) -> str:
    good = [one for one in outcomes if one.loss < 1e-10]
    unidentified = sorted({one.unidentified for one in good})
    return (
        f"| {name} | {S:g} | {len(good)} of {len(outcomes)} | "
        f"{max(one.loss for one in good):.1e} | {max(one.error for one in good):.1e} | "
        f"{np.median([one.evaluations for one in good]):.0f} | "
        f"{np.median([one.seconds for one in good]):.2f} ({max(o.seconds for o in good):.2f}) | "
        f"{' or '.join(unidentified)} |"
    )


def _starts(systems: Iterable[str], count: int) -> None:
    for name in systems:
        system = SYSTEMS[name]()
        recording = demonstration(system)
        for S in (0.1, 0.3):
            found = [fit_from(system, recording, system.truth, S, seed) for seed in range(count)]
            print(_line(name, S, found), flush=True)
            for seed, one in enumerate(found):
                if not one.loss < 1e-10:
                    print(
                        f"  seed {seed}: loss {one.loss:.3g}, {one.seconds:.1f} s; "
                        f"{one.unidentified}"
                    )


def _loops(systems: Iterable[str], count: int, solver: str) -> None:
    for name in [name for name in LOOPS if name in systems]:
        x0, changes = LOOPS[name]
        system = SYSTEMS[name](20)
        truth = system.truth | changes
        loop = system.problem.closed_loop(truth, x0, 60, mu=1e-12)
        recording = system.problem.recorded_loop(loop.x, loop.u)
        for seed in range(count):
            found = fit_from(system, recording, truth, 0.1, seed, solver)
            print(
                f"| {name} | {solver} | {seed} | {found.loss:.1e} | {found.error:.1e} | "
                f"{found.evaluations} | {found.seconds:.1f} | {found.unidentified} |",
                flush=True,
            )


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
            print(f"{name}: {sum(item)} of {len(item)}, {100 * np.mean(item):.1f} %")
        print(f"another direction is not identified in {len(odd)}:", *odd, sep="\n")


if __name__ == "__main__":
    main()
