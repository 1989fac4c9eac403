"""Coverage of intervals and residual tests when the body differs from the nominal one.

    python -m experiments.uncertain_body coverage cart 60 99 0.0   subjects, VAF, correlation
    python -m experiments.uncertain_body coverage seat 20 99 0.0
    python -m experiments.uncertain_body test none 100 99 0.9      error, subjects, VAF, correlation

Every subject has a body drawn from the stated uncertainty and weights drawn about typical ones. The
fit starts without prior knowledge of the weights and uses the nominal body. Errors of `test` are
none, plant (3 % of both coefficients), delay (one sample), limit (5 %) and lean (a constant push of
0.04 of the limit, the effect of 1 degree on a cart that falls as a seated subject does). Results:
experiments/coverage.md.
"""

from __future__ import annotations

import argparse
import collections
import functools
import signal
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import control
import numpy as np
import scipy.linalg

import impc
import plants
from experiments.driver import Row, first_order_noise, kept_rows
from experiments.summary import clustered, counted
from impc.arrays import Array
from impc.assess.lack_of_fit import lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.files.plant_sources import plant_family_of, plant_source
from impc.inverse.problem import Problem

# Time limit of one subject, s: searches for subjects who nearly fall take minutes.
_LONGEST = 300
DT, HORIZON, SAMPLES, LIMIT, KNOWN = 0.05, 10, 400, 0.55, 0.03
Rng = np.random.Generator


class Person(NamedTuple):
    """Inverse problem of a simulated subject, with the true gain and body."""

    problem: Problem
    gain: Array
    truth: Array  # True parameters of the body over nominal ones (k,)


def cart(factors: Sequence[float] = (1.0, 1.0), outputs: int = 1) -> impc.Plant:
    """An unstable cart with two uncertain coefficients."""
    A = np.array([[0.0, 1.0], [1.2 * factors[0], -0.3 * factors[1]]])
    B = np.array([[0.0, 0.0], [1.0, 1.0]])
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 4))]]) * DT)
    names: Any = {"states": ["pos", "vel"], "inputs": ["u", "push"], "outputs": ["pos", "vel"]}
    names["outputs"] = names["outputs"][:outputs]
    return impc.Plant(
        control.ss(held[:2, :2], held[:2, 2:], np.eye(outputs, 2), 0, DT, **names), ["u"]
    )


def moved(law: impc.Controller, push: Array, late: int) -> Array:
    """Outputs of a controller that acts on the state `late` samples ago; NaN after a fall."""
    plant = law.plant
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not late:
            return np.asarray(law.simulate(np.zeros(plant.n), disturbance=push).x[:-1] @ plant.C.T)
        x = [np.zeros(plant.n)] * (late + 1)
        for value in push[:-1]:
            u = law.simulate(x[-1 - late], steps=1).u[0]
            x.append(plant.A @ x[-1] + plant.B @ u + plant.E @ np.array([value]))
            if not np.all(np.abs(x[-1]) < 20):
                return np.full((1, 1), np.nan)
    return np.array(x[late:]) @ plant.C.T


def recorded(
    rng: Rng, nominal: impc.Plant, law: impc.Controller, pushes: Sequence[Array], vaf: float,
    root: float, late: int = 0, lean: float = 0.0,
) -> list[impc.Recording] | None:  # fmt: skip
    """Recordings of a controller; None if a trial ends in a fall."""
    trials, share = [], np.sqrt((100 - vaf) / vaf)
    for push in pushes:
        outputs = moved(law, push + lean, late)
        if not np.all(np.isfinite(outputs)) or np.max(np.abs(outputs)) > 20:
            return None
        added = share * outputs.std(axis=0) * first_order_noise(rng, outputs.shape, root, 200)
        trials.append(impc.Recording(nominal, outputs + added, push))
    return trials


def _law(plant: impc.Plant, weights: impc.Weights, limit: float, N: int) -> impc.Controller:
    bounds = impc.Bounds(plant, u_min=-limit, u_max=limit)
    return impc.Controller(plant, weights, bounds, N, terminal_set=False)


def cart_person(
    seed: int, vaf: float, root: float, error: str = "none", *, stated: bool = True
) -> Person | None:
    """Draw a cart and its recordings; None after a fall."""
    rng = np.random.default_rng([seed, int(vaf), int(10 * root)])
    outputs = 1 + seed % 2
    factors = np.exp(KNOWN * rng.standard_normal(2)) if stated else np.ones(2)
    if error == "plant":
        factors = 1 + 0.03 * rng.choice([-1, 1], 2)
    true, nominal = cart(factors.tolist(), outputs), cart(outputs=outputs)
    weights = impc.Weights(np.diag([4.0, 1.0] * np.exp(rng.uniform(-0.7, 0.7, 2))), 1)
    pushes = [0.4 * np.repeat(rng.choice([-1.0, 0, 1], SAMPLES // 16), 16) for _ in range(2)]
    law = _law(true, weights, LIMIT * (1.05 if error == "limit" else 1.0), HORIZON)
    late, lean = int(error == "delay"), 0.02 * (error == "lean")
    trials = recorded(rng, nominal, law, pushes, vaf, root, late, lean)
    if trials is None:
        return None
    known = dict.fromkeys(("fall", "damp"), f"{100 * KNOWN} %")
    family = impc.PlantFamily(lambda v: cart(v.tolist(), outputs), list(known), [1, 1], known)
    bounds = impc.Bounds(nominal, u_min=-LIMIT, u_max=LIMIT)
    problem = Problem(
        nominal, bounds, HORIZON, trials, unknown_start=True, family=family if stated else None
    )
    return Person(problem, np.array(impc.solve_lqr(true, weights).K), factors)


def seat_person(seed: int, vaf: float, root: float, error: str = "none") -> Person | None:
    """Draw a subject on the linear seat, limit 6 Nm; `error` must be "none"."""
    rng = np.random.default_rng([seed, int(vaf), int(10 * root), 1])
    found = plant_family_of(plant_source("plants:seated_balance_for", {}), ["perturbation"], [])
    assert found is not None
    assert error == "none"
    family = found.linear()
    factors = np.exp(family.deviations * rng.standard_normal(len(family.names)))
    true, nominal = family.make(family.nominal * factors), family.make(family.nominal)
    v = np.array([0.70, 0.65, 0.22, 0.20])
    Q = 1e-2 * np.eye(true.n)
    Q[:4, :4] = np.exp(rng.uniform(-0.7, 0.7)) * 6e5 * np.outer(v, v) / (v @ v)
    Q[:4, :4] += np.diag([2e4, 2e4, 500.0, 500.0] * np.exp(rng.uniform(-0.7, 0.7, 4)))
    weights, limit = impc.Weights(Q, 1), 6.0
    pushes = [
        plants.ternary_torque(duration=30.0, rate=100.0, seed=int(rng.integers(1_000_000)))
        for _ in range(3)
    ]
    trials = recorded(rng, nominal, _law(true, weights, limit, 20), pushes, vaf, root)
    if trials is None or max(np.max(np.abs(trial.outputs)) for trial in trials) > 0.4:
        return None
    bounds = impc.Bounds(nominal, u_min=-limit, u_max=limit)
    problem = Problem(nominal, bounds, 20, trials, unknown_start=True, family=family)
    return Person(problem, np.array(impc.solve_lqr(true, weights).K), factors)


def covered(person: Person) -> Row:
    """Errors of identified entries and directions in standard errors, body uncertain and exact."""
    problem, truth, _ = person
    both = {}
    for name, posed in (("stated", problem), ("exact", problem.with_body_fixed())):
        estimate = gain_estimate(impc.fit(posed))
        deviation, value = np.array(estimate.covariance.entries), np.array(estimate.K)
        identified = np.array(estimate.covariance.individually_identified)
        sure = np.array(estimate.covariance.identified)
        along = np.array(estimate.covariance.along(value - truth))
        both[name] = {
            "z": ((value - truth) / deviation)[identified].tolist(),
            "directions": (along / estimate.covariance.deviations)[sure].tolist(),
            "width": (deviation / np.abs(truth))[identified].tolist(),
            "error": (np.abs(value - truth) / np.abs(truth))[identified].tolist(),
        }
    return both


def tested(person: Person) -> Row:
    """Run the residual test: alarm, and each error with probability and size."""
    found = lack_of_fit(gain_estimate(impc.fit(person.problem)))
    assert found is not None
    errors = [[one.name, one.probability, one.size, one.deviation] for one in found.errors]
    return {"alarm": found.alarm, "errors": errors}


def _too_long(*_: object) -> None:
    raise TimeoutError("takes too long")


def _row(study: str, seed: int, kind: str, what: str, vaf: float, root: float) -> Row:
    """What is counted of one subject; or that they fell, or why there is no fit."""
    make: Callable[..., Person | None] = seat_person if what == "seat" else cart_person
    person = make(seed, vaf, root, "none" if kind == "coverage" else what)
    if person is None:
        return {"failed": "fell"}
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(_LONGEST)
    try:
        return covered(person) if kind == "coverage" else tested(person)
    except (impc.ImpcError, TimeoutError) as refused:
        return {"failed": str(refused)}
    finally:
        signal.alarm(0)


def summary(rows: Sequence[Row]) -> str:
    """Rates with 95 % intervals; coverage is clustered by subject."""
    rows = [row for row in rows if "failed" not in row]
    if not rows or "alarm" in rows[0]:
        alarms = [row["errors"][0][0] for row in rows if row["alarm"]]
        return f"{counted(len(alarms), len(rows))}: {dict(collections.Counter(alarms))}"
    said = [f"{len(rows)} subjects"]
    for kind in ("stated", "exact"):
        for what, key in (("entries", "z"), ("directions", "directions")):
            held = [(np.abs(row[kind][key]) < 1.96).tolist() for row in rows]
            share, error = clustered(held)
            count = sum(map(len, held))
            said.append(f"{kind} {share:.0f} ± {1.96 * error:.0f} % of {count} {what}")
        width, error = (
            np.median(np.concatenate([row[kind][name] for row in rows]))
            for name in ("width", "error")
        )
        said.append(f"standard error {100 * width:.2g} %, error {100 * error:.2g} %")
    return "; ".join(said)


def main() -> None:
    """Fit the subjects that the file does not have, and summarise it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=("coverage", "test"))
    parser.add_argument("what", choices=("cart", "seat", "none", "plant", "delay", "limit", "lean"))
    parser.add_argument("subjects", type=int)
    parser.add_argument("vaf", type=float)
    parser.add_argument("root", type=float)
    parser.add_argument("--out", type=Path, default=Path("results", "uncertain-body.jsonl"))
    given = parser.parse_args()
    study = f"{given.kind} {given.what}, VAF {given.vaf:g}, root {given.root:g}"
    one = functools.partial(_row, kind=given.kind, what=given.what, vaf=given.vaf, root=given.root)
    rows = kept_rows(given.out, one, [(study, seed) for seed in range(given.subjects)])
    print(f"{study}: {summary(rows.get(study, []))}")


if __name__ == "__main__":
    main()
