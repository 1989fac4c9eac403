"""Plans: grid of experiments, falls, groups, and fits to simulated recordings."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
import scipy.stats

from experiments.printed_intervals import carts
from impc.arrays import Array
from impc.checking import replace
from impc.control.controller import Controller
from impc.errors import InputError, SolverError
from impc.levels import Level
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.reporting.provenance import Provenance
from impc.studies.plan.designs import Design, Person, try_design
from impc.studies.plan.report import plan_report
from impc.studies.plan.sentences import (
    RULES,
    Facts,
    halves,
    plan_checks,
    plan_copy,
    stated_as,
    target,
    trials_needed,
    widths,
)
from impc.studies.plan.settings import (
    PlanSettings,
    assumed_gain,
    mechanical_stops,
    noise_deviations,
    plan_settings,
)
from impc.studies.plan.study import (
    SimulatedFits,
    make_plan,
    recorded_noise,
    simulated_fits,
    spread,
    steps_of,
)

GAIN = [[2.0, 2.0]]
SETTINGS = PlanSettings(
    gain=GAIN,
    noise={"position1": 0.03},
    amplitude=[0.4, 0.8, 3.0],
    dwell=[1.0, 2.0],
    trials=1,
    draws=4,
    falls=0.0,
)


def person() -> Person:
    """A cart with a limit of one."""
    plant = carts(1)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    law = Controller.from_gain(plant, GAIN, bounds, 8, terminal_set=False)
    return Person(law, np.array([0.03]), 0.0, np.array([np.inf]))


def perturbation(amplitude: float, dwell: float, number: int) -> Array:
    levels = np.random.default_rng([7, number]).choice([-amplitude, 0, amplitude], (40, 1))
    return np.repeat(levels, round(10 * dwell), axis=0)[:200]


def test_the_best_experiment_is_the_one_that_tells_most_without_a_fall() -> None:
    identified = list[str]()
    plan = make_plan(person(), SETTINGS, perturbation, identified.append)
    assert len(identified) == steps_of(SETTINGS) == 6
    falls = {(item.design.amplitude, item.design.dwell): item.falls for item in plan.outcomes}
    # A push of 3 against a force of 1 for two seconds always ends in a fall.
    assert falls[3.0, 2.0] > 0
    assert falls[0.4, 1.0] == 0
    held = [item for item in plan.outcomes if item.falls == 0]
    variances = [np.mean((item.expected.deviations / GAIN) ** 2) for item in held if item.expected]
    assert plan.best.expected is not None
    assert np.mean((plan.best.expected.deviations / GAIN) ** 2) == min(variances)
    assert plan.best.design.amplitude == 0.8


def test_who_falls_in_every_experiment_is_told_so() -> None:
    settings = replace(SETTINGS, amplitude=[20.0])
    with pytest.raises(SolverError, match="falls in at least 100 % of the trials"):
        make_plan(person(), settings, perturbation)


def test_a_stop_that_is_passed_is_a_fall() -> None:
    free = try_design(person(), Design(0.8, 1.0), perturbation, trials=1, draws=4)
    peak = float(free.peaks[0])
    stopped = replace(person(), stops=np.array([0.999 * peak]))
    assert free.falls == 0
    found = try_design(stopped, Design(0.8, 1.0), perturbation, trials=1, draws=4)
    assert found.falls == 0.25


def test_power_is_that_of_the_noncentral_t() -> None:
    plan = make_plan(person(), replace(SETTINGS, amplitude=[0.8], dwell=[2.0]), perturbation)
    assert plan.best.expected is not None
    for item, own in zip(plan.groups, plan.best.expected.deviations[0] / GAIN[0], strict=True):
        size, deviation = 10, math.hypot(own, 0.3)
        assert item.deviation == pytest.approx(deviation)
        away = 0.5 / deviation * math.sqrt(size / 2)
        edge = float(scipy.stats.t.ppf(0.975, 2 * size - 2))
        power = scipy.stats.nct.sf(edge, 2 * size - 2, away) + scipy.stats.nct.cdf(
            -edge, 2 * size - 2, away
        )
        assert item.powers[0] == pytest.approx(power, rel=1e-6)


def loosely_known(stated: str = "20 %") -> Person:
    """The same cart with uncertain force per command and uncertain limit."""

    def made(values: Array) -> Plant:
        system = control.ss(
            [[0, 1], [0.3, -0.3]], [[0, 0], [values[0], 1]], [[1, 0]], 0,
            inputs=["force1", "push1"], outputs=["position1"],
        )  # fmt: skip
        return Plant(control.c2d(system, 0.1), ["force1"])

    family = PlantFamily(made, ["force"], [1.0], {"force": stated, "u_max": stated})
    return replace(person(), family=family)


def test_a_body_that_is_loosely_known_needs_more_persons_and_is_worth_measuring() -> None:
    one = replace(SETTINGS, amplitude=[0.8], dwell=[2.0], difference=20.0)
    exact, loose = (make_plan(who, one, perturbation) for who in (person(), loosely_known()))
    for known, other in zip(exact.groups, loose.groups, strict=True):
        assert other.needed > known.needed
        assert other.deviation > known.deviation
    levels = [{check.name: check.level for check in plan_checks(one)} for one in (exact, loose)]
    assert [found["Body"] for found in levels] == [Level.AMBER, Level.GREEN]
    assert RULES.verdict(Facts(exact)).words == "Enough"
    assert RULES.verdict(Facts(loose)).words in ("Depends", "Not enough")
    assert any("table of the body" in step for step in RULES.verdict(Facts(loose)).alerts[0].todo)
    tables = {item.name: item.rows for item in plan_report(loose, Provenance()).findings()}
    assert [row[0] for row in tables["body"]] in (
        ["force", "u_max.force1"], ["u_max.force1", "force"]
    )  # fmt: skip
    assert float(tables["body"][0][2]) + float(tables["body"][0][3]) >= float(
        tables["body"][1][2]
    ) + float(tables["body"][1][3])


def test_trials_that_are_needed_are_enough() -> None:
    """The number of trials needed is enough; one trial less is not."""
    noisy = replace(person(), deviation=np.array([0.1]))
    one = replace(SETTINGS, amplitude=[0.8], dwell=[2.0], difference=3.0)
    plan = make_plan(noisy, one, perturbation)
    assert RULES.verdict(Facts(plan)).words != "Enough"
    needed = trials_needed(plan)
    assert 1 < needed < 10
    counts, sides = widths(plan)
    assert list(counts) == [1, 2, 4, 10]
    # An exact body: errors fall with the root of the number of trials.
    np.testing.assert_allclose(sides[0] / sides[2], 2.0, rtol=1e-6)
    for trials, words in ((needed, "Enough"), (max(needed // 2, 1), "Depends Not enough")):
        again = make_plan(noisy, replace(one, trials=int(trials)), perturbation)
        assert RULES.verdict(Facts(again)).words in words
    assert again.best.expected is not None
    assert np.max(halves(again)) > target(plan)


@pytest.mark.parametrize(
    ("half", "words"), [(0.078, "±7.8 %"), (1.2, "±120 %"), (math.inf, "not determined")]
)
def test_an_interval_is_relative_to_the_assumed_value(half: float, words: str) -> None:
    assert stated_as(half) == words


def test_who_is_compared_by_a_gain_that_is_not_determined_is_told_so() -> None:
    noisy = replace(person(), deviation=np.array([30.0]))
    plan = make_plan(noisy, replace(SETTINGS, amplitude=[0.4], dwell=[1.0]), perturbation)
    assert np.isinf([item.needed for item in plan.groups]).all()
    assert plan_copy(plan) == "No number of persons would be enough to detect the difference."
    assert RULES.verdict(Facts(plan)).level is Level.RED


@pytest.mark.parametrize(
    ("who", "noise", "root", "exact"), [("loose", 3e-3, 0.0, 0.3), ("exact", 0.02, 0.5, None)]
)
def test_fits_scatter_as_foreseen(who: str, noise: float, root: float, exact: float | None) -> None:
    """Twenty fits, whose SD has a relative error of 16 %: by the uncertain body, or by noise."""
    someone = loosely_known("5 %") if who == "loose" else person()
    someone = replace(someone, root=root, deviation=np.array([noise]))
    found = try_design(someone, Design(0.8, 2.0), perturbation, trials=1, draws=2)
    assert found.expected is not None
    assert found.problem is not None
    fits = simulated_fits(someone, found.problem, 20, 1)
    assert fits.failed == 0
    if exact is not None:
        assert found.expected.exact is not None
        assert np.all(found.expected.exact < exact * found.expected.deviations)
    ratios = np.std(fits.gains, axis=0) / found.expected.deviations
    assert np.all((ratios > 0.65) & (ratios < 1.35)), ratios
    assert np.all(fits.inside(someone, found.expected) > 0.8)


def test_fits_outside_the_intervals_make_a_plan_doubtful() -> None:
    one = replace(SETTINGS, amplitude=[0.8], dwell=[2.0])
    plan = make_plan(person(), one, perturbation)
    for factor, words in ((1.0, "Enough"), (2.0, "Doubtful")):
        fits = SimulatedFits(np.tile(factor * np.array(GAIN), (20, 1, 1)), 0)
        assert RULES.verdict(Facts(replace(plan, simulated=fits))).words == words


def test_noise_has_the_deviation_and_the_colour_that_were_asked_for() -> None:
    someone = replace(person(), root=0.8)
    noise = recorded_noise(someone, 40_000, np.random.default_rng(2))[:, 0]
    assert np.std(noise) == pytest.approx(0.03, rel=0.03)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.8, abs=0.01)


def test_spread_is_the_deviation_of_normal_numbers() -> None:
    values = np.random.default_rng(5).standard_normal((20_000, 2)) * [1.0, 3.0]
    assert spread(values) == pytest.approx([1.0, 3.0], rel=0.03)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"gain": GAIN, "noise": {}, "amplitude": []}, "amplitude: is empty"),
        ({"gain": GAIN, "noise": {}, "amplitude": [-1.0]}, "amplitude[0]: got -1"),
        ({"gain": GAIN, "noise": {}, "trials": 0}, "trials: got 0"),
        ({"gain": GAIN, "noise": {}, "fits": 3}, "fits: got 3"),
        ({"gain": GAIN, "noise": {}, "trails": 3}, "trails: is not a setting"),
        ({"noise": {}}, "gain"),
    ],
)
def test_settings_are_checked(table: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message.replace("[", r"\[")):
        plan_settings(table)


def test_gain_and_noise_fit_the_plant() -> None:
    plant = carts(1)
    np.testing.assert_array_equal(assumed_gain(plant, SETTINGS), GAIN)
    for wrong in ([[1.0]], [], [[1.0, 2.0]] * 2):
        with pytest.raises(InputError, match="give 1 of 2, for x"):
            assumed_gain(plant, replace(SETTINGS, gain=wrong))
    with pytest.raises(InputError, match="does not stabilise"):  # of u = +Kx
        assumed_gain(plant, replace(SETTINGS, gain=[[-2.0, -2.0]]))
    with pytest.raises(InputError, match="lacks position1"):
        noise_deviations(plant, replace(SETTINGS, noise={}))
    with pytest.raises(InputError, match="is not an output"):
        mechanical_stops(plant, replace(SETTINGS, stops={"angle": 1.0}), {})
    assert mechanical_stops(plant, SETTINGS, {})[0] == np.inf
