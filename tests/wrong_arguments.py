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

import impc
from impc.assess.bounded_weights import weights_set
from impc.checking import replace
from impc.control.closed_loop import simulate

__all__ = ["calls", "values", "wrong_values"]

_FOLDER = tempfile.TemporaryDirectory()
atexit.register(_FOLDER.cleanup)

Call = tuple[Callable[..., Any], dict[str, Any]]


@cache
def values() -> dict[str, Any]:
    """One of each value, of a plant of two states, two inputs and one disturbance."""
    system = control.ss(
        [[1.1, 0.4], [0.0, 0.8]], [[0.2, 0.1, 0.3], [1, 0.5, 0]], np.eye(2), 0, True
    )
    two = impc.Plant(system, ["u[0]", "u[1]"])
    x, u, w = (ca.SX.sym(name) for name in "xuw")
    box = impc.Bounds(two, u_min=-1, u_max=1)
    pair = impc.Weights(np.diag([2.0, 1.0]), np.diag([1.0, 3.0]))
    law = impc.Controller(two, pair, box, 4)
    drive = impc.scenario(two, [0.3, -0.2], disturbance=0.1 * np.sin(np.arange(30.0)))
    run = simulate(law, drive)
    trial = impc.Recording(two, run.x, np.append(drive.disturbance, [[0.0]], axis=0))
    problem = impc.Problem(two, box, 4, (trial,))
    solution = impc.solve_lqr(two, pair)
    fibre = impc.gain_fibre(two, solution.K)
    return {
        "system": system, "plant": two, "bounds": box, "weights": pair, "controller": law,
        "scenario": drive, "simulation": run, "recording": trial, "problem": problem,
        "solution": solution, "fibre": fibre, "set": weights_set(fibre), "terminal": law.terminal,
        "point": impc.OptimalControlProblem(
            x, u, {"price": w}, x + u, w * x**2 + u**2, 2
        ),
        "family": impc.PlantFamily(lambda _: two, ["mass"], [1.0]),
    }  # fmt: skip


@cache
def wrong_values() -> dict[str, Any]:
    """What is given by mistake: for some arguments it means the same, and then it works."""
    masked = np.ma.masked_array(np.ones((30, 2)), mask=False)
    masked[3, 1] = np.ma.masked
    half = np.ma.masked_array(np.eye(2), mask=[[True, False], [False, False]])
    return {
        **{f"a {name}": value for name, value in values().items()},
        "None": None, "text": "text", "no text": "", "lines": "one\ntwo", "bytes": b"bytes",
        "True": True, "minus one": -1, "zero": 0, "half": 0.5, "10 ** 400": 10**400,
        "2 ** 63": 2**63, "2 ** 31 - 1": 2**31 - 1, "NaN": float("nan"), "infinite": float("inf"),
        "1e308": 1e308, "denormal": 5e-324, "float32": np.float32(0.5), "complex": 1 + 2j,
        "nothing": np.zeros(0), "a zero-dimensional array": np.array(1.0),
        "ragged": [[1.0, 2.0], [3.0]], "with None": [[1.0, None], [0.0, 1.0]],
        "words": ["one", "two"], "numbers as text": [["1", "0"], ["0", "1"]],
        "complex array": np.eye(2) * 1j, "long": np.ones(1000), "large": np.ones((100, 100)),
        "three axes": np.ones((2, 2, 2)), "with NaN": np.array([[np.nan, 1.0], [1.0, 1.0]]),
        "huge": np.full((2, 2), 1e308), "denormals": np.full((2, 2), 5e-324),
        "dates": np.array(["2026-01-01"], dtype="datetime64[D]"),
        "objects": np.array([object(), object()]), "records": np.zeros(2, dtype=[("x", float)]),
        "masked": masked, "masked square": half,
        "frame": pd.DataFrame({"x": [1.0, 2.0], "y": [3.0, 4.0]}),
        "frame of words": pd.DataFrame({"x": ["a", "b"], "y": ["c", "d"]}),
        "series with NA": pd.Series([1, None], dtype="Int64"), "sparse": scipy.sparse.eye_array(2),
        "dictionary": {"x": 1.0}, "set": {1.0, 2.0}, "generator": (item for item in (1.0, 2.0)),
        "function": len, "type": float, "object": object(),
    }  # fmt: skip


def changed(value: Any) -> Call:
    """A value with its own fields, as `replace` takes them."""

    def change(**fields: Any) -> Any:
        return replace(value, **fields)

    return change, {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def _of_files() -> list[Call]:
    """Files that are there, in a folder that stays until Python ends."""
    folder = Path(_FOLDER.name)
    columns = {"t": np.arange(30.0), "y": np.sin(np.arange(30.0))}
    made = impc.make_table("simulated", columns)
    trial, lab = folder / "trial.csv", folder / "lab.toml"
    impc.write_table(trial, made)
    one = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1, outputs=["y"]))
    lab.write_text('[recording]\ntime = "t"\n[signals.y]\ncolumn = "y"\nunit = "1"\n')
    settings = impc.read_configuration(lab)
    table = {"source": "s", "columns": columns, "units": {"y": "m"}, "skipped": {"z": "is text"}}
    return [
        (impc.make_table, table),
        (impc.read_table, {"path": trial, "largest": 10**6}),
        (impc.write_table, {"path": folder / "again.csv", "table": made}),
        (impc.read_configuration, {"path": lab}),
        (impc.read_recordings, {"paths": [trial], "configuration": settings, "plant": one}),
    ]


def calls() -> list[Call]:
    """A right call of every public function: name by name, all required and optional arguments."""
    v = values()
    K, S, states, size = v["solution"].K, v["solution"].S, np.eye(2), np.ones(2)
    two, box, pair, trial = v["plant"], v["bounds"], v["weights"], v["recording"]
    problem, about = {"problem": v["problem"]}, {"plant": two, "gain": K}
    made = {"bounds": box, "horizon": 4, "terminal_set": True, "softening": 1e6}
    own = {**made, "terminal_set": v["terminal"], "terminal_weight": states}
    demonstrated = v["point"].recorded_plan(np.ones((3, 1)), np.ones((2, 1)))
    return [
        (impc.Plant, {"system": v["system"], "controls": ["u[0]", "u[1]"]}),
        (impc.Bounds, {"plant": two, "x_min": -size, "x_max": 9, "u_min": -1, "u_max": size}),
        (impc.Weights, {"Q": states, "R": states}),
        (impc.weight_error, {"estimate": pair, "truth": pair}),
        (impc.Recording, {
            "plant": two, "outputs": trial.outputs, "disturbance": trial.disturbance, "x0": size,
            "label": impc.Label("one"), "findings": ("none",), "target": {"y[0]": 1.0},
            "commands": np.zeros((30, 2)), "offset": np.zeros(2),
        }),
        (impc.Observer, {
            "plant": two, "sensed": ["x[0]", "x[1]"], "motor": 0.1, "share": size, "process": size,
            "sensory": 0.1, "walk": 0.2, "persistence": 0.5,
        }),
        (impc.solve_lqr, {"plant": two, "weights": pair}),
        (impc.maximal_invariant_set, {
            **about, "bounds": box, "tolerance": 1e-9, "max_steps": 500, "near": v["terminal"],
        }),
        (impc.Controller, {"plant": two, "weights": pair, **made}),
        (impc.Controller, {"plant": two, "weights": pair, **own}),
        (impc.Controller.from_gain, {**about, **made, "metric": S, "near": v["terminal"]}),
        (impc.scenario, {"plant": two, "x0": size, "steps": 30, "disturbance": np.zeros(30)}),
        (impc.scenario, {"plant": two, "x0": size, "steps": 30, "target": {"y[0]": 1.0}}),
        (impc.steady_state, {"plant": two, "target": {"y[0]": 1.0}, "bounds": box}),
        (impc.with_observer, {"plant": two, "rate": 1.0}),
        (impc.with_preview, {"plant": two, "signals": ["y[0]"], "samples": 2}),
        (impc.require_complete, {"controller": v["controller"], "simulation": v["simulation"]}),
        (impc.directions, {"controller": v["controller"], "count": 1, "K": K}),
        (impc.Problem, {
            "plant": two, **made, "recordings": (trial,), "output_scale": size,
            "unknown_start": False, "family": v["family"], "command_scale": size, "offsets": [],
        }),
        (impc.gain_fibre, {**about, "metric": S}),
        (impc.least_condition_weights, {"fibre": v["fibre"]}),
        (impc.other_weights, {"fibre": v["fibre"], "count": 2, "condition_ratio": 10.0}),
        (impc.inverse_lqr_lmi, about),
        (impc.inverse_lqr_gradient, {**about, "start": pair, "max_evaluations": 3}),
        (impc.table_3_1, {**problem, "absolute": False}),
        (impc.fit, {**problem, "method": "inverse_mpc", "start": pair}),
        (impc.identifiability, {**problem, "weights": pair}),
        (impc.vaf, {"recorded": trial.outputs, "simulated": trial.outputs}),
        (impc.PlantFamily, {"make": len, "names": ["mass"], "nominal": [1.0]}),
        *_of_files(),
        (impc.Structure, {"plant": two, "Q": "diagonal", "R": "full", "name": "one"}),
        (impc.expected_intervals, {
            **problem, "gain": v["controller"].K, "deviation": 0.01, "metric": None, "root": 0.0,
        }),
        (v["point"].plan, {"theta": {"price": 1.0}, "x0": [1.0], "solver": "ipopt", "mu": 1e-9}),
        (impc.fit_optimal_control, {
            "problem": v["point"], "recordings": [demonstrated], "start": {"price": 1.0},
            "evaluations": 3, "starts": 1,
        }),
        (impc.Label, {"subject": "a", "visit": "b", "condition": "c", "trial": "d"}),
        *map(changed, (two, box, trial, v["controller"], v["problem"])),
    ]  # fmt: skip
