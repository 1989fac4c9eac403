"""People who sense with noise: the fit of least squares beside maximum likelihood, with coverage.

A cart of two states under a push of three levels, whose person senses position and velocity. Noise
is in the motor, in the senses, or in both, of a size that leaves the motion without noise a VAF of
90 or 70 %; the limit of the command is far away, or met at a tenth of the samples and more. Prices
are log-uniform within a factor of two. Each line that is written is a subject, so that a run can be
ended at any time and be summed up:

    python -m experiments.noisy_people_study run --noise motor --vaf 90 --subjects 200 --out a.jsonl
    python -m experiments.noisy_people_study sum a.jsonl
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import control
import numpy as np

from impc.assess.covariance import gain_covariance
from impc.assess.person_covariance import person_covariance
from impc.assess.variance_accounted_for import vaf
from impc.control.closed_loop import scenario, simulate
from impc.control.controller import Controller
from impc.control.noisy_person import simulate_person
from impc.errors import ImpcError
from impc.inverse.likelihood_fit import fit_person
from impc.inverse.methods import estimate
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.observer import Observer
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.arrays import Array

__all__ = ["NOISES", "Score", "score", "subject"]

#: Noise of each kind before it is scaled: motor (N), position (m), velocity (m/s).
NOISES = {
    "motor": (1.0, 0.005, 0.01),
    "sensory": (0.05, 0.05, 0.1),
    "both": (1.0, 0.05, 0.1),
}
_SAMPLES, _TRIALS, _DWELL = 600, 3, 10
_PUSH, _HORIZON = 0.7, 5
# Of the standard deviation of the recorded position.
_RECORDER = 0.02
_NORMAL = 1.959964


@dataclass(frozen=True)
class Score:
    """A subject.

    Attributes
    ----------
    study : str
        Noise, VAF and limit.
    seed : int
    saturated : float
        Share of the samples at the limit.
    vaf : float
        Of the motion without noise, %.
    truth, least, likely : list of float
        Gain: that of the subject, of least squares and of maximum likelihood.
    least_deviations, likely_deviations, expected_deviations : list of float
        Their standard deviations; of the likelihood by the sandwich, and as expected.
    levels, found, level_deviations : list of float
        Motor, senses, recorder: true, found, and deviations of their logarithms.
    converged : bool
    seconds : list of float
        Of the two fits.
    """

    study: str
    seed: int
    saturated: float
    vaf: float
    truth: list[float]
    least: list[float]
    likely: list[float]
    least_deviations: list[float]
    likely_deviations: list[float]
    expected_deviations: list[float]
    levels: list[float]
    found: list[float]
    level_deviations: list[float]
    converged: bool
    seconds: list[float]


def cart() -> Plant:
    """Mass on wheels, 20 samples a second."""
    system = control.ss(
        [[1, 0.05], [0, 0.98]], [[0, 0], [0.05, 0.05]], [[1, 0]], 0, 0.05,
        states=["x", "v"], inputs=["u", "push"], outputs=["x"],
    )  # fmt: skip
    return Plant(system, ["u"])


@dataclass(frozen=True)
class Subject:
    """A person, as simulated."""

    controller: Controller
    person: Observer
    recorder: float
    pushes: Sequence[Array]


def subject(seed: int, noise: str, share: float, limit: float) -> Subject:
    """A subject whose motion without noise has a VAF of about `share` %."""
    rng = np.random.default_rng([seed, round(share), list(NOISES).index(noise), round(100 * limit)])
    plant = cart()
    prices = np.array([8.0, 1.0]) * np.exp(rng.uniform(-np.log(2), np.log(2), 2))
    bounds = Bounds(plant, u_min=-limit, u_max=limit)
    law = Controller(plant, Weights(np.diag(prices), 1), bounds, _HORIZON, terminal_set=False)
    pushes = [
        np.repeat(rng.choice([-_PUSH, 0.0, _PUSH], _SAMPLES // _DWELL), _DWELL)
        for _ in range(_TRIALS)
    ]
    low, high = -4.0, 1.5
    for _ in range(14):  # of the logarithm of the noise's size
        middle = (low + high) / 2
        if _agreement(law, _person(plant, noise, np.exp(middle)), pushes, rng) > share:
            low = middle
        else:
            high = middle
    found = _person(plant, noise, np.exp(low))
    clean = simulate(law, scenario(plant, [0, 0], disturbance=pushes[0])).x[:, 0]
    return Subject(law, found, float(_RECORDER * np.std(clean)), pushes)


def _person(plant: Plant, noise: str, size: float) -> Observer:
    motor, place, speed = np.array(NOISES[noise]) * size
    return Observer(plant, ["x", "v"], motor=motor, sensory=[place, speed])


def _agreement(
    law: Controller, person: Observer, pushes: Sequence[Array], rng: np.random.Generator
) -> float:
    shares = []
    for push in pushes:
        clean = simulate(law, scenario(law.plant, [0, 0], disturbance=push)).x[:-1]
        noisy = simulate_person(law, person, push, seed=int(rng.integers(2**31)))
        shares.append(vaf(noisy.states[:, :1], clean[:, :1])[0])
    return float(np.mean(shares))


def score(who: Subject, study: str, seed: int) -> Score:
    """Both fits of a subject, and their deviations."""
    law, plant, trials = who.controller, who.controller.plant, []
    met, shares = [], []
    for number, push in enumerate(who.pushes):
        found = simulate_person(law, who.person, push, recorder=who.recorder, seed=[seed, number])
        clean = simulate(law, scenario(plant, [0, 0], disturbance=push)).x[:-1, :1]
        met.append(np.mean(np.abs(found.u) >= law.bounds.u_max - 1e-9))
        shares.append(vaf(found.states[:, :1], clean)[0])
        trials.append(Recording(plant, found.outputs, push))
    problem = Problem(plant, law.bounds, _HORIZON, trials, terminal_set=False, unknown_start=True)
    started = time.perf_counter()
    first = estimate(problem)
    least = gain_covariance(
        first.problem, np.array(first.gain), np.array(first.metric), curvature=True
    )
    middle = time.perf_counter()
    likely = fit_person(first, who.person.with_levels(_sized(who.person)))
    ended = time.perf_counter()
    robust, expected = (person_covariance(likely, kind) for kind in ("sandwich", "expected"))
    return Score(
        study,
        seed,
        float(np.mean(met)),
        float(np.mean(shares)),
        law.K.ravel().tolist(),
        np.ravel(first.gain).tolist(),
        likely.K.ravel().tolist(),
        least.entries.ravel().tolist(),
        robust.entries.ravel().tolist(),
        expected.entries.ravel().tolist(),
        [*who.person.motor, *who.person.sensory, who.recorder],
        [*likely.observer.motor, *likely.observer.sensory, *likely.recorder],
        expected.levels.tolist(),
        likely.converged,
        [middle - started, ended - middle],
    )


def _sized(person: Observer) -> Array:
    """Levels to start from that know nothing of the subject but which there are."""
    return np.where(person.levels > 0, 0.1, 0.0)


def _run(given: argparse.Namespace) -> None:
    study = f"{given.noise}, VAF {given.vaf:g}, limit {given.limit:g}"
    Path(given.out).parent.mkdir(parents=True, exist_ok=True)
    with Path(given.out).open("a", encoding="utf-8") as file:
        for seed in range(given.first, given.first + given.subjects):
            who = subject(seed, given.noise, given.vaf, given.limit)
            try:
                line = asdict(score(who, study, seed))
            except ImpcError as error:  # counted: most are of the first fit, of a cart that ran off
                line = {"study": study, "seed": seed, "reason": str(error)}
            file.write(json.dumps(line) + "\n")
            file.flush()


def _summed(scores: list[Score]) -> str:
    """One row of the table."""
    truth = np.array([one.truth for one in scores])
    cells = [
        scores[0].study,
        str(len(scores)),
        f"{100 * np.mean([one.saturated for one in scores]):.0f}",
    ]
    for name in ("least", "likely"):
        error = np.array([getattr(one, name) for one in scores]) - truth
        bias = np.mean(error, axis=0) / np.std(error, axis=0, ddof=1)
        size = np.sqrt(np.mean((error / truth) ** 2, axis=0))
        cells += [_list(bias, 2), _list(100 * size, 0)]
        for kind in ("least",) if name == "least" else ("likely", "expected"):
            deviations = np.array([getattr(one, f"{kind}_deviations") for one in scores])
            cells.append(_shares(np.abs(error) <= _NORMAL * deviations))
    levels = np.array([np.log(one.found) - np.log(one.levels) for one in scores])
    deviations = np.array([one.level_deviations for one in scores])
    cells.append(_shares(np.abs(levels) <= _NORMAL * deviations))
    cells.append(_list(np.median([one.seconds for one in scores], axis=0), 1))
    return "| " + " | ".join(cells) + " |"


def _shares(holds: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> str:
    share = np.mean(holds, axis=0)
    error = 100 * np.sqrt(np.max(share * (1 - share)) / len(holds))
    return f"{_list(100 * share, 0)} (± {error:.1f})"


def _list(values: Array, digits: int) -> str:
    return ", ".join(f"{float(item):.{digits}f}" for item in values)


def _sum(given: argparse.Namespace) -> None:
    heads = (
        "study", "subjects", "at the limit %",
        "least squares: bias / sd", "error %", "95 % holds %",
        "likelihood: bias / sd", "error %", "sandwich holds %", "expected holds %",
        "levels hold %", "seconds",
    )  # fmt: skip
    print("| " + " | ".join(heads) + " |")
    print("|" + "---|" * len(heads))
    by_study: dict[str, list[Score]] = {}
    for name in given.files:
        for line in Path(name).read_text(encoding="utf-8").splitlines():
            found = json.loads(line)
            if "reason" in found:
                print(f"not fitted: {found['study']}, {found['seed']}: {found['reason']}")
            else:
                by_study.setdefault(found["study"], []).append(Score(**found))
    for scores in by_study.values():
        print(_summed(scores))


def main() -> None:
    """Run a study, or sum up what runs have written."""
    parser = argparse.ArgumentParser(description="People who sense with noise.")
    which = parser.add_subparsers(required=True)
    run = which.add_parser("run")
    run.add_argument("--noise", choices=tuple(NOISES), required=True)
    run.add_argument("--vaf", type=float, default=90.0)
    run.add_argument("--limit", type=float, default=5.0)
    run.add_argument("--subjects", type=int, default=200)
    run.add_argument("--first", type=int, default=0)
    run.add_argument("--out", required=True)
    run.set_defaults(run=_run)
    summed = which.add_parser("sum")
    summed.add_argument("files", nargs="+")
    summed.set_defaults(run=_sum)
    given = parser.parse_args()
    given.run(given)


if __name__ == "__main__":
    main()
