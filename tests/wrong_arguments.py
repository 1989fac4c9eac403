"""Every public function with right arguments, and what people give in their place."""

from __future__ import annotations

import atexit
import dataclasses
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import control
import numpy as np
import pandas as pd
import scipy.sparse

from impc.assess import bounded_weights, expected
from impc.assess import variance_accounted_for as agreement
from impc.assess import weights_test as identifiability
from impc.checking import replace
from impc.control import casadi_controller as mpc
from impc.control import closed_loop, constraint_rows, controller, simulation, terminal_set
from impc.files import configuration, formats, reading, table, units
from impc.files import plant_sources as plant_source
from impc.inverse import direct_and_reduced as inverse_mpc
from impc.inverse import equivalent_weights, inverse_lqr, residuals
from impc.inverse import gain_search as gain
from impc.inverse import noisy_fit as fitted_controller
from impc.inverse import problem as inverse_problem
from impc.inverse import solution_set as gain_fibre
from impc.model import bounds, plant, plant_family, structure, weights
from impc.model import recordings as recording
from impc.model import riccati as lqr
from impc.nonlinear import fit as nonlinear_fit
from impc.nonlinear import problem as nonlinear_problem
from impc.output_feedback import observer

__all__ = ["calls", "wrong_values"]

_FOLDER = tempfile.TemporaryDirectory()
atexit.register(_FOLDER.cleanup)

Call = tuple["Callable[..., Any]", dict[str, Any]]


@cache
def values() -> dict[str, Any]:
    """One of each value, of a plant of two states, two inputs and one disturbance."""
    system = control.ss(
        [[1.1, 0.4], [0.0, 0.8]], [[0.2, 0.1, 0.3], [1, 0.5, 0]], np.eye(2), 0, True
    )
    two = plant.Plant(system, ["u[0]", "u[1]"])
    x, u, w = (ca.SX.sym(name) for name in "xuw")
    box = bounds.Bounds(two, u_min=-1, u_max=1)
    pair = weights.Weights(np.diag([2.0, 1.0]), np.diag([1.0, 3.0]))
    law = controller.Controller(two, pair, box, 4)
    drive = simulation.scenario(two, [0.3, -0.2], disturbance=0.1 * np.sin(np.arange(30.0)))
    run = closed_loop.simulate(law, drive)
    trial = recording.Recording(two, run.x, np.append(drive.disturbance, [[0.0]], axis=0))
    problem = inverse_problem.Problem(two, box, 4, (trial,))
    solution = lqr.solve_lqr(two, pair)
    fibre = gain_fibre.gain_fibre(two, solution.K)
    return {
        "system": system,
        "plant": two,
        "bounds": box,
        "weights": pair,
        "controller": law,
        "scenario": drive,
        "simulation": run,
        "recording": trial,
        "problem": problem,
        "solution": solution,
        "fibre": fibre,
        "set": bounded_weights.weights_set(fibre),
        "mpc": mpc.build_mpc(law),
        "structured": replace(problem, structure=structure.Structure(two, "diagonal")),
        "point": nonlinear_problem.OptimalControlProblem(
            x, u, {"price": w}, x + u, w * x**2 + u**2, 2
        ),
        "terminal": law.terminal,
        "family": plant_family.PlantFamily(lambda _: two, ["mass"], [1.0]),
        "source": plant_source.plant_source("plants:yalmip_example", {}),
    }


@cache
def wrong_values() -> dict[str, Any]:
    """What is given by mistake: for some arguments it means the same, and then it works."""
    known = values()
    masked = np.ma.masked_array(np.ones((30, 2)), mask=False)
    masked[3, 1] = np.ma.masked
    return {
        **{f"a {name}": value for name, value in known.items()},
        "None": None,
        "text": "text",
        "no text": "",
        "lines": "one\ntwo",
        "bytes": b"bytes",
        "True": True,
        "minus one": -1,
        "zero": 0,
        "half": 0.5,
        "10 ** 400": 10**400,
        "2 ** 63": 2**63,
        "2 ** 31 - 1": 2**31 - 1,
        "NaN": float("nan"),
        "infinite": float("inf"),
        "1e308": 1e308,
        "denormal": 5e-324,
        "float32": np.float32(0.5),
        "complex": 1 + 2j,
        "nothing": np.zeros(0),
        "a zero-dimensional array": np.array(1.0),
        "ragged": [[1.0, 2.0], [3.0]],
        "with None": [[1.0, None], [0.0, 1.0]],
        "words": ["one", "two"],
        "numbers as text": [["1", "0"], ["0", "1"]],
        "complex array": np.eye(2) * 1j,
        "long": np.ones(1000),
        "large": np.ones((100, 100)),
        "three axes": np.ones((2, 2, 2)),
        "with NaN": np.array([[np.nan, 1.0], [1.0, 1.0]]),
        "huge": np.full((2, 2), 1e308),
        "denormals": np.full((2, 2), 5e-324),
        "dates": np.array(["2026-01-01"], dtype="datetime64[D]"),
        "objects": np.array([object(), object()]),
        "records": np.zeros(2, dtype=[("x", float)]),
        "masked": masked,
        "masked square": np.ma.masked_array(np.eye(2), mask=[[True, False], [False, False]]),
        "frame": pd.DataFrame({"x": [1.0, 2.0], "y": [3.0, 4.0]}),
        "frame of words": pd.DataFrame({"x": ["a", "b"], "y": ["c", "d"]}),
        "series with NA": pd.Series([1, None], dtype="Int64"),
        "sparse": scipy.sparse.eye_array(2),
        "dictionary": {"x": 1.0},
        "set": {1.0, 2.0},
        "generator": (item for item in (1.0, 2.0)),
        "function": len,
        "type": float,
        "object": object(),
    }


def changed(value: Any) -> Call:
    """A value with its own fields, as `replace` takes them."""

    def change(**fields: Any) -> Any:
        return replace(value, **fields)

    return change, {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def _of_files() -> list[Call]:
    """Files that are there, in a folder that stays until Python ends."""
    folder = Path(_FOLDER.name)
    columns = {"t": np.arange(30.0), "y": np.sin(np.arange(30.0))}
    made = table.make_table("simulated", columns)
    formats.write_table(folder / "trial.csv", made)
    one = plant.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1, outputs=["y"]))
    text = '[recording]\ntime = "t"\n[signals.y]\ncolumn = "y"\nunit = "1"\n'
    (folder / "lab.toml").write_text(text)
    settings = configuration.read_configuration(folder / "lab.toml")
    return [
        (
            table.make_table,
            {"source": "s", "columns": columns, "units": {"y": "m"}, "skipped": {"z": "is text"}},
        ),
        (formats.read_table, {"path": folder / "trial.csv", "largest": 10**6}),
        (formats.write_table, {"path": folder / "again.csv", "table": made}),
        (configuration.read_configuration, {"path": folder / "lab.toml"}),
        (
            reading.read_recordings,
            {"paths": [folder / "trial.csv"], "configuration": settings, "plant": one},
        ),
    ]


def calls() -> list[Call]:
    """A right call of every public function: name by name, all required and optional arguments."""
    v = values()
    K, S = v["solution"].K, v["solution"].S
    states, size = np.eye(2), np.ones(2)
    trial = v["recording"]
    problem = {"problem": v["problem"]}
    about = {"plant": v["plant"], "gain": K}
    limits: dict[str, Any] = {"plant": v["plant"], "weights": v["weights"], "bounds": v["bounds"]}
    return [
        (plant.Plant, {"system": v["system"], "controls": ["u[0]", "u[1]"]}),
        (plant.change_coordinates, {"plant": v["plant"], "T": states, "G": states}),
        (
            bounds.Bounds,
            {"plant": v["plant"], "x_min": -size, "x_max": 9, "u_min": -1, "u_max": size},
        ),
        (bounds.bound_rows, {"bounds": v["bounds"], "plant": v["plant"]}),
        (weights.Weights, {"Q": states, "R": states}),
        (weights.condition_number, {"weights": v["weights"]}),
        (weights.normalised, {"weights": v["weights"]}),
        (weights.weight_error, {"estimate": v["weights"], "truth": v["weights"]}),
        (
            recording.Recording,
            {
                "plant": v["plant"],
                "outputs": trial.outputs,
                "disturbance": trial.disturbance,
                "x0": size,
                "label": recording.Label("one"),
                "findings": ("none",),
            },
        ),
        (
            observer.Observer,
            {
                "plant": v["plant"],
                "sensed": ["x[0]", "x[1]"],
                "motor": 0.1,
                "share": size,
                "process": size,
                "sensory": 0.1,
                "walk": 0.2,
                "persistence": 0.5,
            },
        ),
        (lqr.solve_lqr, {"plant": v["plant"], "weights": v["weights"]}),
        (lqr.is_stable, {"F": states / 2, "discrete": True}),
        (lqr.gain_gradients, {"solution": v["solution"]}),
        (lqr.metric_gradients, {"solution": v["solution"]}),
        (
            terminal_set.maximal_invariant_set,
            {
                **about,
                "bounds": v["bounds"],
                "tolerance": 1e-9,
                "max_steps": 500,
                "near": v["terminal"],
            },
        ),
        (terminal_set.contains, {"terminal": v["terminal"], "x": size}),
        (controller.Controller, {**limits, "horizon": 4, "terminal_set": True, "softening": 1e6}),
        (
            controller.Controller.from_gain,
            {
                **about,
                "bounds": v["bounds"],
                "horizon": 4,
                "metric": S,
                "terminal_set": True,
                "softening": 1e6,
                "near": v["terminal"],
            },
        ),
        (
            simulation.scenario,
            {"plant": v["plant"], "x0": size, "steps": 30, "disturbance": np.zeros(30)},
        ),
        (simulation.scenario, {"plant": v["plant"], "x0": size, "steps": 30}),
        (closed_loop.simulate, {"controller": v["controller"], "given": v["scenario"]}),
        (
            simulation.require_complete,
            {"controller": v["controller"], "simulation": v["simulation"]},
        ),
        (
            inverse_problem.Problem,
            {
                "plant": v["plant"],
                "bounds": v["bounds"],
                "horizon": 4,
                "recordings": (trial,),
                "terminal_set": True,
                "softening": 1e6,
                "output_scale": size,
                "unknown_start": False,
                "family": v["family"],
            },
        ),
        (gain_fibre.gain_fibre, {**about, "metric": S}),
        (equivalent_weights.weights_margin, {"fibre": v["fibre"]}),
        (equivalent_weights.least_condition_weights, {"fibre": v["fibre"]}),
        (equivalent_weights.analytic_centre, {"fibre": v["fibre"]}),
        (
            equivalent_weights.other_weights,
            {"fibre": v["fibre"], "count": 2, "condition_ratio": 10.0},
        ),
        (bounded_weights.weights_set, {"fibre": v["fibre"], "ratio": 10.0}),
        (bounded_weights.linear_ranges, {"found": v["set"], "directions": np.eye(4)[None]}),
        (bounded_weights.linear_maxima, {"found": v["set"], "directions": np.eye(4)[None]}),
        (bounded_weights.entry_ranges, {"found": v["set"], "states": [0]}),
        (inverse_lqr.inverse_lqr_lmi, about),
        (inverse_lqr.inverse_lqr_gradient, {**about, "start": v["weights"], "max_evaluations": 3}),
        (inverse_lqr.inverse_lqr_cross_term, about),
        (inverse_mpc.infer_weights, problem),
        (inverse_mpc.starting_point, problem),
        (
            inverse_mpc.inverse_mpc,
            {
                **problem,
                "start": v["weights"],
                "condition_weight": 0.0,
                "squared": False,
                "max_iterations": 2,
            },
        ),
        (inverse_mpc.inverse_mpc_reduced, problem),
        (residuals.verify_hard, {**problem, "weights": v["weights"]}),
        (gain.fit_gain, problem),
        (fitted_controller.fit_controller, {**problem, "start": v["weights"]}),
        (identifiability.identifiability, {**problem, "weights": v["weights"]}),
        (mpc.build_mpc, {"controller": v["controller"], "solver": "daqp"}),
        (mpc.solve_mpc, {"mpc": v["mpc"], "x": size}),
        (mpc.simulate_mpc, {"mpc": v["mpc"], "given": v["scenario"]}),
        (agreement.vaf, {"recorded": trial.outputs, "simulated": trial.outputs}),
        (agreement.centred_vaf, {"recorded": trial.outputs, "simulated": trial.outputs}),
        (agreement.whiteness, {"residual": trial.outputs, "lags": 3}),
        (agreement.saturated_share, {"u": v["simulation"].u, "u_min": -size, "u_max": size}),
        (plant_source.plant_source, {"name": "plants:yalmip_example", "arguments": {}}),
        (plant_source.make_plant, {"source": v["source"], "recorded": ["d"]}),
        (plant_family.PlantFamily, {"make": len, "names": ["mass"], "nominal": [1.0]}),
        (plant_family.plant_at, {"family": v["family"], "logarithms": np.zeros(1)}),
        (units.si_unit, {"written": "deg"}),
        *_of_files(),
        (structure.Structure, {"plant": v["plant"], "Q": "diagonal", "R": "full", "name": "one"}),
        (constraint_rows.directions, {"controller": v["controller"], "count": 1, "K": K}),
        (
            expected.expected_intervals,
            {"problem": v["structured"], "prices": np.zeros(3), "deviation": 0.01, "root": 0.0},
        ),
        (v["point"].plan, {"theta": {"price": 1.0}, "x0": [1.0], "solver": "ipopt", "mu": 1e-9}),
        (
            nonlinear_fit.fit_optimal_control,
            {
                "problem": v["point"],
                "recordings": [v["point"].recorded_plan(np.ones((3, 1)), np.ones((2, 1)))],
                "start": {"price": 1.0},
                "evaluations": 3,
                "starts": 1,
            },
        ),
        changed(v["plant"]),
        changed(v["bounds"]),
        (weights.Weights, {"Q": states, "R": states}),
        changed(trial),
        (recording.Label, {"subject": "a", "visit": "b", "condition": "c", "trial": "d"}),
        (simulation.Scenario, {"x0": size, "disturbance": np.zeros((9, 1))}),
        changed(v["controller"]),
        changed(v["problem"]),
    ]
