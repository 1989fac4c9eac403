"""Curves as numbers, for the script of a page: methods on a trial, weights that move nothing.

A chart is a dictionary that `impc/reporting/page.js` reads:

    title, label, step    what it shows, of its time axis, and s between two of its samples
    curves                label, color and dash of each; the first is drawn thick
    panels                a signal each: label, bounds, and values of every curve (null: none)
    positions             weights to walk through: label, difference, cost weights, mixed cost
    weights over
                          the root of both (-1 to 1), values of the last curve in every panel
    cost weights, mixed         names of these numbers

Long trials are drawn with every k-th sample (docs/results.md).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from impc.checking import replace
from impc.control.closed_loop import simulate
from impc.inverse.methods import METHODS
from impc.inverse.problem import controller_for, scenarios
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights, normalised
from impc.reporting.rendering import plain
from impc.reporting.shown_units import axis_label, shown_unit
from impc.reporting.style import (
    BLUE,
    DOUBLE_COLUMN,
    GREEN,
    INK,
    VERMILLION,
    new_figure,
)
from impc.studies.methods_table import until_its_end

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from impc.arrays import Array
    from impc.assess.assessments import MethodFit
    from impc.assess.intent_statements import Intent
    from impc.inverse.problem import Problem

# Samples that are drawn of a trial. Of the weights' chart, which has a curve a position: how many
# are simulated, and each how many-th is drawn.
_SAMPLES, _FEW, _EACH = 1500, 400, 2
# Mixed cost weights that are shown.
_MIXED = 3
# Weights between one rule's and the next.
_BETWEEN = 3
_COLOURS = (VERMILLION, BLUE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#222222")
_DASHES = ("6 3", "2 2", "8 2 2 2", "")
_RECORDED = {"label": "recorded", "color": "#8C8C8C", "dash": ""}


def methods_chart(problem: Problem, fits: Sequence[MethodFit], trial: int) -> dict[str, Any]:
    """Every method's outputs and commands on one trial, beside what was recorded."""
    drawn = [fit for fit in fits if fit.runs]
    plant, given = problem.plant, problem.recordings[trial]
    stride = -(-given.samples // _SAMPLES)
    runs = [until_its_end(plant, fit.runs[trial]) for fit in drawn]
    outputs = [given.without_offset, *(y for y, _ in runs)]
    unknown = np.full((given.samples, plant.m), np.nan)
    commands = [given.commands if len(given.commands) else unknown, *(u for _, u in runs)]
    return {
        "title": f"Recorded, and simulated by {len(drawn)} methods",
        "label": "time (s)",
        "step": plant.dt * stride,
        "curves": [_RECORDED, *(_curve(METHODS[fit.name].label, k) for k, fit in enumerate(drawn))],
        "panels": _panels(problem, outputs, commands, stride),
    }


def chart_figure(data: dict[str, Any], shown: int) -> Figure:
    """The first `shown` curves of a chart as a picture, for a page without scripts."""
    figure = new_figure(DOUBLE_COLUMN, 0.6 + 1.3 * len(data["panels"]))
    axes = figure.subplots(len(data["panels"]), 1, sharex=True, squeeze=False)[:, 0]
    for ax, panel in zip(axes, data["panels"], strict=True):
        for place, values in enumerate(panel["curves"][:shown]):
            curve, numbers = data["curves"][place], np.array(values, dtype=np.float64)
            dash = [float(part) for part in curve["dash"].split()]
            ax.plot(
                data["step"] * np.arange(len(numbers)),
                numbers,
                color=curve["color"],
                linewidth=1.2 if place else 2.5,
                linestyle=(0, dash) if dash else "-",
                label=curve["label"],
            )
        for limit in panel["bounds"]:
            ax.axhline(limit, color=INK, linewidth=0.8, linestyle=":")
        ax.set_ylabel(panel["label"])
    axes[0].legend(loc="lower left", ncols=3, bbox_to_anchor=(0.0, 1.0))
    axes[-1].set_xlabel(data["label"])
    return figure


def weights_chart(problem: Problem, found: Intent) -> dict[str, Any]:
    """Weights with one gain, from each rule's to the next one's, and a trial simulated with each.

    Of weights with one gain every mixture has it too (docs/equivalent-weights.md), so the way from
    one rule to the next is a straight line; the closed loop of each is simulated, not taken over.
    """
    plant, drive = problem.plant, scenarios(problem)[0]
    few = replace(drive, disturbance=drive.disturbance[:_FEW])
    pairs = _path(found)
    laws = [solve_lqr(plant, one) for _, one in pairs]
    runs = [simulate(controller_for(problem, law.K, law.S), few) for law in laws]
    outputs = [run.x[:-1] @ plant.C.T for run in runs]
    commands = [run.u for run in runs]
    own = _panels(problem, [outputs[0]] * 2, [commands[0]] * 2, _EACH)
    largest = float(np.max(np.abs(commands[0])))
    sizes = np.asarray(found.sizes)
    scaled = np.array([one.Q * np.outer(sizes, sizes) for _, one in pairs])
    mixed, names = _mixed(scaled, plant.states)
    positions = []
    for place, ((label, _), y, u) in enumerate(zip(pairs, outputs, commands, strict=True)):
        moved = float(np.max(np.abs(u - commands[0]))) / largest if largest else 0.0
        panels = _panels(problem, [y], [u], _EACH)
        positions.append(
            {
                "label": f"{label}.",
                "difference": f"The command differs by {moved:.0e} of its largest value at most.",
                "cost_weights": plain(np.diag(scaled[place])),
                "mixed": plain(mixed[place]),
                "panels": [panel["curves"][0] for panel in panels],
            }
        )
    return {
        "title": "The same movement under every one of the weights",
        "label": "time (s)",
        "step": _EACH * plant.dt,
        "curves": [
            {**_RECORDED, "label": "reported weights"},
            _curve("the weights of the slider", 0),
        ],
        "panels": own,
        "positions": positions,
        "cost_weights": [f"cost weight of {name}" for name in plant.states],
        "mixed": names,
    }


def _mixed(scaled: Array, states: tuple[str, ...]) -> tuple[Array, list[str]]:
    """Of the mixed weights of Q (k, n, n) over their roots the few that move most, and names."""
    roots = np.sqrt(np.maximum(np.diagonal(scaled, axis1=1, axis2=2), np.finfo(float).tiny))
    shares = scaled / (roots[:, :, None] * roots[:, None, :])
    rows, columns = np.triu_indices(len(states), 1)
    pairs = shares[:, rows, columns]
    most = np.argsort(-np.ptp(pairs, axis=0), kind="stable")[:_MIXED]
    return pairs[:, most], [f"{states[rows[one]]} with {states[columns[one]]}" for one in most]


def _path(found: Intent) -> list[tuple[str, Weights]]:
    """The weights of every rule, with mixtures between them, and where on the way each stands."""
    readings = found.readings
    pairs = [(readings[0].rule, readings[0].weights)]
    for one, other in itertools.pairwise(readings):
        for step in range(1, _BETWEEN + 1):
            share = step / (_BETWEEN + 1)
            mixed = Weights(
                (1 - share) * one.weights.Q + share * other.weights.Q,
                (1 - share) * one.weights.R + share * other.weights.R,
            )
            pairs.append((f"{100 * share:.0f} % of the way to: {other.rule}", normalised(mixed)))
        pairs.append((other.rule, other.weights))
    return pairs


def _curve(label: str, place: int) -> dict[str, str]:
    return {
        "label": label,
        "color": _COLOURS[place % len(_COLOURS)],
        "dash": _DASHES[place % len(_DASHES)],
    }


def _panels(
    problem: Problem, outputs: Sequence[Array], commands: Sequence[Array], stride: int
) -> list[dict[str, Any]]:
    plant, bounds = problem.plant, problem.bounds
    panels = []
    for names, curves, low, high in (
        (plant.outputs, outputs, None, None),
        (plant.controls, commands, bounds.u_min, bounds.u_max),
    ):
        for column, name in enumerate(names):
            factor = shown_unit(plant, name)[0]
            limits = [] if low is None or high is None else [low[column], high[column]]
            panels.append(
                {
                    "label": axis_label(plant, name),
                    "bounds": [float(factor * one) for one in limits if np.isfinite(one)],
                    "curves": [_short(factor * part[::stride, column]) for part in curves],
                }
            )
    return panels


def _short(values: Array) -> list[float | None]:
    """Five digits: a screen has four."""
    return [float(f"{one:.5g}") if np.isfinite(one) else None for one in values]
