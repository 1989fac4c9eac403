"""Simulate and fit seated subjects whose controller predicts with the full equations.

    python -m experiments.nonlinear_seat people    torques, recordings, fits, and the figure
    python -m experiments.nonlinear_seat prices    cost weights, with full equations and without

The simulated body has its full equations throughout. A *full* subject predicts with them too
(`experiments.nonlinear_mpc`), a *linear* one with their linearisation at rest. The torque limit is
1.2 times the amplitude of the torque on the seat. Results: experiments/nonlinear_seat.md.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from experiments.nonlinear_mpc import build_nonlinear_mpc, simulate_nonlinear
from experiments.nonlinear_seat_figure import seat_figure
from experiments.reference_mpc import solve_mpc
from experiments.seat_problem import DIRECTION, TRUTH, seat_problem
from impc.assess.covariance import gain_covariance
from impc.assess.long_run_covariance import white_noise
from impc.cli.seat import HORIZON, seat_controller, seat_weights
from impc.control.casadi_controller import build_mpc
from impc.control.closed_loop import simulate
from impc.control.feasibility import require_complete
from impc.control.simulation import scenario
from impc.inverse.methods import fit
from impc.inverse.problem import Problem, recorded_size
from impc.inverse.search import free_gain
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.structure import Structure
from impc.nonlinear.fit import fit_optimal_control
from plants import seated_balance_for, ternary_torque

if TYPE_CHECKING:
    from collections.abc import Sequence

    from experiments.nonlinear_mpc import NonlinearMpc
    from impc.arrays import Array
    from impc.control.controller import Controller
    from impc.control.simulation import Scenario, Simulation

__all__ = ["Amplitude", "Fitted", "compare_at", "first_torques", "fitted_person", "fitted_prices"]

_RATE, _SHARE = 100.0, 1.2
_NOISE = np.radians(0.03)  # Recording noise at 100 samples a second
FIGURE = Path(__file__).parent / "images" / "nonlinear-seat.png"


@dataclass(frozen=True)
class Fitted:
    """Fit with nonlinear body and linear prediction, compared with the truth.

    Attributes
    ----------
    error : float
        Largest relative error of the four gains of angles and rates, without noise.
    torque : float
        Error of -K x without noise where the limit is not reached: root mean square over that of
        the truth.
    vaf : float
        %, without noise.
    deviations : float
        Largest error of an entry of the gain over its standard error (`deviations_at`).
    """

    error: float
    torque: float
    vaf: float
    deviations: float


@dataclass(frozen=True)
class Amplitude:
    """A full subject under a torque on the seat.

    Attributes
    ----------
    amplitude, angle : float
        Amplitude of the torque, N m, and largest angle, rad.
    seat : Array
        Angle of the seat at each sample, shape (samples,), rad.
    torques : Array
        First torques from each state, of this subject and of a linear one (samples, 2), N m.
    where : Array
        Limit in the linear plan: 0 never active, 1 later, 2 at the first sample (samples,).
    fitted : Fitted
    """

    amplitude: float
    angle: float
    seat: Array
    torques: Array
    where: Array
    fitted: Fitted


def first_torques(tilts: Sequence[float], together: bool) -> Array:
    """First torques (tilts, 2) from rest at each tilt (rad), full and linear, without a limit, N m.

    The seat is tilted alone, or the trunk with it.
    """
    controller = _person(np.inf)
    plant = controller.plant
    x0 = np.zeros((len(tilts), plant.n))
    x0[:, 0] = tilts
    x0[:, 1] = x0[:, 0] * together
    full = [simulate_nonlinear(_full(controller), scenario(plant, one, 1)).u[0, 0] for one in x0]
    return np.column_stack([full, -(x0 @ controller.K.T)[:, 0]])


def compare_at(amplitude: float, seconds: float) -> Amplitude:
    """Simulate a full subject at one amplitude of the torque on the seat, and fit the recording."""
    limit = _SHARE * amplitude
    controller = _person(limit)
    plant = controller.plant
    torque = ternary_torque(amplitude, duration=seconds, rate=_RATE)
    drive = scenario(plant, np.zeros(plant.n), disturbance=torque)
    run = require_complete(controller, simulate_nonlinear(_full(controller), drive))
    x = run.x[:-1]
    plans = _linear_plans(controller, x)
    reached = np.abs(np.column_stack([run.u, plans])) > 0.999 * limit
    where = np.where(reached[:, :2].any(axis=1), 2, np.where(reached.any(axis=1), 1, 0))
    return Amplitude(
        amplitude,
        float(np.max(np.abs(run.x[:, :2]))),
        np.abs(x[:, 0]),
        np.column_stack([run.u[:, 0], plans[:, 0]]),
        where,
        fitted_person(controller, drive, run, deviations_at(amplitude)),
    )


def fitted_person(
    controller: Controller, drive: Scenario, run: Simulation, deviations: Array
) -> Fitted:
    """Fit a noise-free trial from the true weights, and compare with the gain at rest."""
    truth, plant = np.ravel(controller.K), controller.plant
    problem = _problem(controller, [drive], [run.x @ plant.C.T])
    found = free_gain(problem, seat_weights(plant))
    change = np.ravel(found.K) - truth
    x = run.x[:-1][np.abs(run.u[:, 0]) < 0.999 * controller.bounds.u_max[0]]
    return Fitted(
        float(np.max(np.abs(change[:4] / truth[:4]))),
        float(np.linalg.norm(x @ change) / np.linalg.norm(x @ truth)),
        100 * (1 - (found.misfit / recorded_size(problem)) ** 2),
        float(np.max(np.abs(change) / np.ravel(deviations))),
    )


def deviations_at(amplitude: float, trials: int = 3, seconds: float = 30.0) -> Array:
    """Standard errors of the gain (1, n) of a linear subject with the default recording noise."""
    controller = _person(_SHARE * amplitude)
    plant, rng = controller.plant, np.random.default_rng(0)
    drives = [
        scenario(
            plant,
            np.zeros(plant.n),
            disturbance=ternary_torque(
                amplitude, duration=seconds, rate=_RATE, seed=None if k == 0 else k
            ),
        )
        for k in range(trials)
    ]
    clean = [simulate(controller, drive).x @ plant.C.T for drive in drives]
    noisy = [one + _NOISE * rng.standard_normal(one.shape) for one in clean]
    found = free_gain(_problem(controller, drives, noisy), seat_weights(plant))
    return gain_covariance(found.problem, found.K, found.S, white_noise).entries


def fitted_prices(amplitude: float, steps: int) -> dict[str, Array]:
    """Fitted cost weights over true ones, with the full equations and with linear prediction.

    The states are recorded without noise and the limit is known; the search starts 25 to 30 % off.
    """
    truth = {**TRUTH, "limit": _SHARE * amplitude}
    problem = seat_problem().with_known({"limit": truth.pop("limit")})
    torque = ternary_torque(duration=5.0, rate=_RATE)[:steps, None] * (amplitude / 5.0)
    loop = problem.closed_loop(truth, np.zeros(problem.n), steps, d=torque, mu=1e-12)
    names = list(truth)
    start = {name: value * factor for (name, value), factor in
             zip(truth.items(), (1.3, 0.75, 1.3), strict=True)}  # fmt: skip
    recording = problem.recorded_loop(loop.x, loop.u, d=torque)
    full = fit_optimal_control(problem, [recording], start).theta
    plant = _person(_SHARE * amplitude).plant
    line = " + ".join(f"{v:g} {name}" for v, name in zip(DIRECTION, plant.states[:4], strict=True))
    structure = Structure(plant, [line, "theta1", "theta2"])
    bounds = Bounds(plant, u_min=-_SHARE * amplitude, u_max=_SHARE * amplitude)
    trial = Recording(plant, loop.x @ plant.C.T, np.vstack([torque, torque[-1:]]), loop.x[0])
    posed = Problem(plant, bounds, HORIZON, [trial], terminal_set=False, structure=structure)
    linear = fit(posed, "structured").cost_weights
    assert linear is not None
    true = np.array([truth[name] for name in names])
    return {
        "angle": np.array([np.max(np.abs(loop.x[:, :2]))]),
        "full": np.array([full[name] for name in names]) / true,
        "linear": np.exp(linear) / true,
    }


def _person(limit: float) -> Controller:
    return seat_controller({}, limit)


def _full(controller: Controller) -> NonlinearMpc:
    plant = controller.plant
    step, weights = seated_balance_for().body(), seat_weights(plant)
    return build_nonlinear_mpc(step, plant, weights, controller.bounds, HORIZON)


def _problem(
    controller: Controller, drives: Sequence[Scenario], outputs: Sequence[Array]
) -> Problem:
    plant = controller.plant
    trials = [
        Recording(plant, y, np.vstack([drive.disturbance, drive.disturbance[-1:]]), drive.x0)
        for drive, y in zip(drives, outputs, strict=True)
    ]
    return Problem(plant, controller.bounds, HORIZON, trials, terminal_set=False)


def _linear_plans(controller: Controller, x: Array) -> Array:
    """Torques (samples, N) that the linear subject plans from each state (samples, n)."""
    mpc = build_mpc(controller, "daqp")
    return np.array([np.ravel(solve_mpc(mpc, one).plan) for one in x])


def _print_tilts(tilts: Sequence[float], found: dict[str, Array]) -> None:
    for name, torques in found.items():
        print(f"{name}: tilt deg | linear N m | full N m | difference N m | of it %")
        for tilt, (full, linear) in zip(tilts, torques, strict=True):
            share = 100 * (full / linear - 1)
            print(f"| {tilt:g} | {linear:.2f} | {full:.2f} | {full - linear:.3f} | {share:.2f} |")


def _print_amplitude(found: Amplitude) -> None:
    print(f"{found.amplitude:g} N m, to {np.degrees(found.angle):.2f} deg", flush=True)
    gap = np.abs(found.torques[:, 0] - found.torques[:, 1])
    for kind, word in enumerate(("free", "limit later in the plan", "at the limit")):
        here = found.where == kind
        if np.any(here):
            sizes = np.sqrt(np.mean(gap[here] ** 2)), np.max(gap[here])
            share = 100 * sizes[0] / np.sqrt(np.mean(found.torques[here, 1] ** 2))
            print(
                f"  {word}: {100 * np.mean(here):.0f} % of the samples, root mean square "
                f"{sizes[0]:.4f} N m ({share:.2f} %), most {sizes[1]:.3f} N m"
            )
    one = found.fitted
    print(
        f"  gain off by {100 * one.error:.2f} %, its torque by {100 * one.torque:.3f} %, VAF "
        f"{one.vaf:.5f} %, {one.deviations:.1f} standard errors",
        flush=True,
    )


def main() -> None:
    """Print the tables of a study."""
    parser = argparse.ArgumentParser(description="Subjects who predict with the full equations.")
    parser.add_argument("study", choices=("people", "prices"))
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[1.0, 2.5, 5.0, 7.5, 10.0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--steps", type=int, default=60, help="samples of `prices`")
    given = parser.parse_args()
    if given.study == "prices":
        for amplitude in given.amplitudes:
            off = fitted_prices(amplitude, given.steps)
            print(
                f"{amplitude:g} N m, to {np.degrees(off['angle'][0]):.2f} deg: full "
                f"{off['full'] - 1}, linear {off['linear'] - 1}",
                flush=True,
            )
        return
    tilts = np.arange(1.0, 13.0)
    from_rest = {
        "seat tilted alone": first_torques(np.radians(tilts), together=False),
        "trunk tilted with the seat": first_torques(np.radians(tilts), together=True),
    }
    _print_tilts(list(tilts), from_rest)
    people = []
    for amplitude in tqdm(given.amplitudes, unit="amplitude", disable=None):
        people.append(compare_at(amplitude, given.seconds))
        _print_amplitude(people[-1])
    FIGURE.write_bytes(seat_figure(tilts, from_rest, people))


if __name__ == "__main__":
    main()
