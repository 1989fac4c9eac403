"""Carts and seats whose body is not the nominal one: coverage of intervals, and lack of fit.

    python -m experiments.uncertain_body coverage cart 60 99 0.0    persons, VAF, correlation
    python -m experiments.uncertain_body coverage seat 20 99 0.0
    python -m experiments.uncertain_body test none 100 99 0.9       error, persons, VAF, correlation

Every person has a body drawn from the stated uncertainty and weights drawn about typical ones, and
is fitted as a user would: from nothing, with the nominal body. One line of JSON a person. Errors of
`test` are none, plant (3 % of both coefficients), delay (one sample), limit (5 %) and lean (a
constant push of 2 % of the limit, 1 degree of a cart that falls like a person on the seat).
"""

from __future__ import annotations

import json
import sys
import warnings

import control
import numpy as np
import scipy.linalg
import scipy.signal

import impc
from impc.assess.lack_of_fit import lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.files.plant_sources import plant_family_of, plant_source

DT, HORIZON, SAMPLES, LIMIT, KNOWN = 0.05, 10, 400, 0.55, 0.03


def cart(factors=(1.0, 1.0), outputs=1):
    """A cart that falls: its two coefficients are uncertain."""
    A = np.array([[0.0, 1.0], [1.2 * factors[0], -0.3 * factors[1]]])
    B = np.array([[0.0, 0.0], [1.0, 1.0]])
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((2, 4))]]) * DT)
    names = {"states": ["pos", "vel"], "inputs": ["u", "push"], "outputs": ["pos", "vel"][:outputs]}
    system = control.ss(held[:2, :2], held[:2, 2:], np.eye(outputs, 2), 0, DT, **names)
    return impc.Plant(system, ["u"])


def noise(rng, samples, p, root):
    """Stationary first-order noise of variance one (samples, p)."""
    white = rng.standard_normal((samples + 200, p))
    return scipy.signal.lfilter([np.sqrt(1 - root**2)], [1.0, -root], white, axis=0)[200:]


def recorded(rng, nominal, true, weights, limit, pushes, vaf, root, late=0, lean=0.0):
    """Recordings of a person on the true plant; None of one who falls."""
    law = impc.Controller(
        true, weights, impc.Bounds(true, u_min=-limit, u_max=limit), HORIZON, terminal_set=False
    )
    trials, share = [], np.sqrt((100 - vaf) / vaf)
    for push in pushes:
        outputs = moved(law, push + lean, late)
        if not np.all(np.isfinite(outputs)) or np.max(np.abs(outputs)) > 20:
            return None
        added = share * outputs.std(axis=0) * noise(rng, len(push), outputs.shape[1], root)
        trials.append(impc.Recording(nominal, outputs + added, push))
    return trials


def moved(law, push, late):
    """Outputs of a law that answers the state of `late` samples ago."""
    plant = law.plant
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not late:
            return law.simulate(np.zeros(plant.n), disturbance=push).x[:-1] @ plant.C.T
        x = [np.zeros(plant.n)] * (late + 1)
        for value in push[:-1]:
            u = law.simulate(x[-1 - late], steps=1).u[0]
            x.append(plant.A @ x[-1] + plant.B @ u + plant.E @ [value])
            if not np.all(np.abs(x[-1]) < 20):
                return np.full((1, 1), np.nan)
    return np.array(x[late:]) @ plant.C.T


def cart_person(seed, vaf, root, error="none", drawn=True):
    """One cart and its recordings: problem, true gain, or None."""
    rng = np.random.default_rng([seed, int(vaf), int(10 * root)])
    outputs = 1 + seed % 2
    factors = np.exp(KNOWN * rng.standard_normal(2)) if drawn else np.ones(2)
    if error == "plant":
        factors = 1 + 0.03 * rng.choice([-1, 1], 2)
    true, nominal = cart(factors, outputs), cart(outputs=outputs)
    weights = impc.Weights(np.diag([4.0, 1.0] * np.exp(rng.uniform(-0.7, 0.7, 2))), 1)
    pushes = [0.4 * np.repeat(rng.choice([-1.0, 0, 1], SAMPLES // 16), 16) for _ in range(2)]
    limit = LIMIT * (1.05 if error == "limit" else 1.0)
    late, lean = int(error == "delay"), 0.02 * (error == "lean")
    trials = recorded(rng, nominal, true, weights, limit, pushes, vaf, root, late, lean)
    if trials is None:
        return None
    known = {"fall": f"{100 * KNOWN} %", "damp": f"{100 * KNOWN} %"}
    family = impc.PlantFamily(
        lambda values: cart(values, outputs), ["fall", "damp"], [1, 1], known if drawn else None
    )
    bounds = impc.Bounds(nominal, u_min=-LIMIT, u_max=LIMIT)
    posed = family if drawn else None
    problem = impc.Problem(nominal, bounds, HORIZON, trials, unknown_start=True, family=posed)
    return problem, np.array(impc.solve_lqr(true, weights).K), factors


def seat_person(seed, vaf, root, error="none", drawn=True):
    """One person on the seat with the linear body: problem, true gain, or None."""
    rng = np.random.default_rng([seed, int(vaf), int(10 * root), 1])
    family = plant_family_of(plant_source("plants:seated_balance_for", {}), ["perturbation"], [])
    family = family.linear()
    logarithms = family.deviations * rng.standard_normal(len(family.names)) * drawn
    true, nominal = family.make(family.nominal * np.exp(logarithms)), family.make(family.nominal)
    costs = np.log([6e3, 9e3, 6e2, 4e2]) + rng.uniform(-0.7, 0.7, 4)
    weights = impc.Structure(nominal, list(nominal.states[:4])).weights(costs)
    pushes = [5 * np.repeat(rng.choice([-1.0, 0, 1], 120), 25) for _ in range(3)]
    trials = recorded(rng, nominal, true, weights, 70.0, pushes, vaf, root)
    if trials is None or max(np.max(np.abs(trial.outputs)) for trial in trials) > 0.6:
        return None
    bounds = impc.Bounds(nominal, u_min=-70.0, u_max=70.0)
    problem = impc.Problem(nominal, bounds, 20, trials, unknown_start=True, family=family)
    return problem, np.array(impc.solve_lqr(true, weights).K), np.exp(logarithms)


def covered(person):
    """Whether each interval of an identified entry holds, with and without the uncertainty."""
    problem, truth, _ = person
    found = impc.fit(problem)
    both, exact = {}, impc.fit(problem.with_body_fixed())
    for name, estimate in (("stated", gain_estimate(found)), ("exact", gain_estimate(exact))):
        deviation, value = np.array(estimate.covariance.entries), np.array(estimate.K)
        identified = np.array(estimate.covariance.individually_identified)
        both[name] = {
            "z": ((value - truth) / deviation)[identified].tolist(),
            "width": (deviation / np.abs(truth))[identified].tolist(),
            "error": (np.abs(value - truth) / np.abs(truth))[identified].tolist(),
        }
    return both


def tested(person):
    """The test of lack of fit: alarm, culprit, sizes."""
    found = lack_of_fit(gain_estimate(impc.fit(person[0])))
    return {
        "alarm": found.alarm,
        "errors": [[e.name, e.probability, e.size, e.deviation] for e in found.errors],
    }


def main(kind, what, count, vaf, root, first="0", drawn="1"):
    """Print one line a person."""
    made = seat_person if what == "seat" else cart_person
    error = "none" if kind == "coverage" else what
    for seed in range(int(first), int(first) + int(count)):
        person = made(seed, float(vaf), float(root), error, drawn == "1")
        if person is None:
            continue
        try:
            found = covered(person) if kind == "coverage" else tested(person)
        except impc.ImpcError as refused:
            found = {"failed": str(refused)}
        print(json.dumps({"seed": seed, **found}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
