"""The first sentence of a fit's page: what forbids most comes first."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest

from impc.assess.lack_of_fit import LackOfFit, ModelError
from impc.checking import replace
from impc.control.controller import Controller
from impc.files.plant_sources import plant_source
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.reporting.shown_units import angles_in, signal_words
from impc.studies.charts import methods_chart, weights_chart
from impc.studies.fit.body_words import added_sentence
from impc.studies.fit.figures import trajectory_figure
from impc.studies.fit.interval_figures import gain_figure, shown_statements, statements_figure
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_problem, fit_recordings, stages
from impc.studies.fit.verdict import abstract, missing, verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from impc.arrays import Array
    from impc.studies.fit.result import FitResult

SEED = 20264


@cache
def fitted(limit: float) -> FitResult:
    """A cart that is pushed, with a little noise in its recorder; the command stops at a limit."""
    cart = control.c2d(control.ss([[0, 1], [0, 0]], [[0, 0], [1, 1]], [[1, 0]], [[0, 0]]), 0.1)
    cart = control.ss(
        cart.A, cart.B, cart.C, cart.D, 0.1, states=["place", "speed"], inputs=["pull", "push"],
        outputs=["place"],
    )  # fmt: skip
    units = {"place": "m", "speed": "m/s", "pull": "m/s^2", "push": "m/s^2"}
    words = {"place": "place of the cart", "pull": "pull of the rope"}
    plant = Plant(cart, ["pull"], units, words)
    law = Controller(plant, Weights([[4, 0], [0, 1]], 1), Bounds(plant, u_max=1.0, u_min=-1.0), 5)
    rng = np.random.default_rng(SEED)
    push = 1.2 * np.repeat(rng.choice([-1.0, 0.0, 1.0], 30), 5)[:, None]
    moved = law.simulate([0.0, 0.0], disturbance=push, steps=len(push))
    outputs = moved.x[: len(push), :1] + 0.005 * rng.standard_normal((len(push), 1))
    settings = FitSettings(u_max=limit, horizon=5, methods=["inverse_lqr_output"])
    heard: list[str] = []
    problem = fit_problem(plant, [Recording(plant, outputs, push)], settings)
    result = fit_recordings(problem, settings, heard.append)
    assert len(heard) == stages(problem, settings)
    return result


def test_a_fit_that_nothing_speaks_against() -> None:
    result = replace(fitted(1.0), lack=(None,))
    assert verdict(result).startswith("Inverse MPC explains the recordings inside the bound")
    lines = abstract(result)
    assert 3 <= len(lines) <= 6
    assert (
        "looks 0.5 s ahead (5 samples), limited to 1 m/s^2 of pull (pull of the rope)" in lines[0]
    )
    assert f"{result.inverse_mpc.vaf[0]:.2f} % of place (place of the cart) (VAF)" in lines[2]
    share = 100 * result.trials[0].saturated
    assert share > 5
    assert f"at its bound for {share:.1f} % of the time" in lines[3]
    assert signal_words(result.given.plant) == (
        ("place", "Place of the cart, in m."), ("pull", "Pull of the rope, in m/s^2.")
    )  # fmt: skip


def test_an_error_of_the_model_is_said_first() -> None:
    plain = fitted(1.0)
    alarm = LackOfFit((ModelError("delay", 1e-5, 11.5, 1.0, 0.1),), alarm=True, untestable=())
    other = replace(plain, lack=(alarm,))
    assert "is not that of the model" in verdict(other)
    (said,) = other.warnings
    assert "A delay of the command of 100 ± 10 ms explains most of it (p < 0.0001)" in said
    assert added_sentence(replace(other, lack=(alarm, None))).startswith("A first fit left what")


@pytest.mark.full
def test_no_limit_and_a_limit_that_is_not_reached() -> None:
    assert "No limit of the command or of a state was given" in verdict(
        replace(fitted(np.inf), lack=(None,))
    )
    assert "without a limit" in abstract(fitted(np.inf))[0]
    assert "No bound is ever active" in verdict(replace(fitted(50.0), lack=(None,)))


def test_what_is_not_given_is_said_with_what_that_excludes() -> None:
    source = plant_source("plants:seated_balance_for", {"mass": 70.0})
    assert missing(FitSettings(), source) == (
        "Not given: u_max: without a limit of the command inverse MPC is inverse LQR; "
        "the subject's own height: the gains are those of height 1.66."
    )
    assert missing(FitSettings(u_max=6.0, free=["height"]), source) == ""
    cursor = plant_source("plants:cursor_plant", {})
    assert missing(FitSettings(u_max=6.0), cursor) == ""


def bars(ax: Axes) -> list[Array]:
    """Both ends of each line, from below to above on the page."""
    found = [np.asarray(line.get_xdata(), dtype=np.float64) for line in ax.lines]
    return [ends for ends in found if len(ends) == 2]


def test_angles_are_shown_as_is_asked() -> None:
    """In the figures of a fit whose output is an angle."""
    result = fitted(1.0)
    turned = replace(result.given.plant, units=(("place", "rad"), ("pull", "rad/s^2")))
    shown = replace(result, fitted=replace(
        result.fitted, problem=replace(result.fitted.problem, plant=turned)
    ))  # fmt: skip
    for angles, label, factor in (("degrees", "deg", 180 / np.pi), ("radians", "rad", 1.0)):
        with angles_in(angles):
            ax = trajectory_figure(shown, 0).axes[0]
        assert ax.get_ylabel() == f"place ({label})"
        (line, _) = ax.lines
        recorded = factor * result.given.recordings[0].outputs[:, 0]
        np.testing.assert_allclose(np.asarray(line.get_ydata()), recorded)


def test_curves_of_the_page_are_those_of_the_fit() -> None:
    result = fitted(1.0)
    data = methods_chart(result.given, result.methods[::-1], 0)
    assert [one["label"] for one in data["curves"]][:2] == ["recorded", "inverse MPC, direct (3.6)"]
    place, pull = data["panels"]
    assert (place["label"], pull["label"], pull["bounds"]) == ("place (m)", "pull (m/s^2)", [-1, 1])
    recorded, run = result.given.recordings[0].outputs[:, 0], result.inverse_mpc.runs[0]
    # Five digits are kept.
    np.testing.assert_allclose(place["curves"][0], recorded, rtol=1e-4)
    np.testing.assert_allclose(place["curves"][1], run.x[:, 0][: len(recorded)], rtol=1e-4)
    assert pull["curves"][0] == [None] * len(recorded)
    np.testing.assert_allclose(pull["curves"][1][:-1], run.u[:, 0][: len(recorded) - 1], rtol=1e-4)
    assert len({len(one) for panel in data["panels"] for one in panel["curves"]}) == 1


def test_weights_of_the_slider_move_prices_and_nothing_else() -> None:
    result = fitted(1.0)
    data = weights_chart(result.fitted.problem, result.intent)
    # Of this cart, a double integrator, only the mixed cost weight is free: from 0 to 0.93,
    # measured.
    cost_weights = np.array([one["cost_weights"] for one in data["positions"]])
    np.testing.assert_allclose(
        cost_weights, np.tile(cost_weights[0], (len(cost_weights), 1)), rtol=1e-9
    )
    assert data["mixed"] == ["place with speed"]
    mixed = np.array([one["mixed"] for one in data["positions"]])
    assert np.ptp(mixed) > 0.9
    assert len(cost_weights) == 4 * len(result.intent.readings) - 3
    for one in data["positions"]:
        for panel, values in zip(data["panels"], one["panels"], strict=True):
            np.testing.assert_allclose(values, panel["curves"][0], rtol=1e-4, atol=1e-9)


def test_bars_are_the_intervals() -> None:
    result = fitted(1.0)
    (ax,) = gain_figure(result).axes
    sizes = dict(zip(result.given.plant.states, result.intent.sizes, strict=True))
    first = {item.name: item for item in reversed(result.uncertainty.intervals)}
    for bar, (name, size) in zip(bars(ax), sizes.items(), strict=False):
        item = first[f"K.pull.{name}"]
        np.testing.assert_allclose(bar, [size * item.low, size * item.high])
    assert [label.get_text() for label in ax.get_yticklabels()] == ["place", "speed"]
    shown = shown_statements(result)
    (ax,) = statements_figure(result).axes
    ends = np.array([[item.low, item.high] for item in shown])
    np.testing.assert_allclose(bars(ax)[: len(shown)], ends)


@pytest.mark.parametrize("vaf", [40.0, 60.0])
def test_little_is_called_little(vaf: float) -> None:
    plain = replace(fitted(1.0), lack=(None,))
    poor = replace(plain.inverse_mpc, vaf=np.array([vaf]))
    result = replace(plain, methods=(*plain.methods[:-1], poor))
    assert verdict(result).startswith("The fitted controller explains less than half") == (vaf < 50)
