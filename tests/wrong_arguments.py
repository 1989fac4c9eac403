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
    x, u, w, d = (ca.SX.sym(name) for name in "xuwd")
    point: dict[str, Any] = {
        "states": x, "inputs": u, "parameters": {"price": w}, "next_state": x + u,
        "stage_cost": w * x**2 + u**2, "horizon": 2, "terminal_cost": 0,
        "constraints": {"u": u - 9}, "terminal_constraints": {"x": x - 9},
        "disturbances": None, "signed": ["price"],
        "units": {"price": "1"}, "dt": 0.1,
    }  # fmt: skip
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
        "scenario": drive,
        "open": impc.Controller(two, pair, box, 4, terminal_set=False),
        "simulation": run, "recording": trial, "problem": problem,
        "solution": solution, "fibre": fibre, "set": weights_set(fibre), "terminal": law.terminal,
        "point": impc.OptimalControlProblem(**point), "point arguments": point,
        "wide point": impc.OptimalControlProblem(
            x, u, {"price": w, "goal": d}, x + u, w * (x - d) ** 2 + u**2, 2
        ),
        "estimate": impc.fit(problem), "family": impc.PlantFamily(lambda _: two, ["mass"], [1.0]),
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
        "function": len, "type": float, "object": object(), "folder": Path(_FOLDER.name),
        "empty": {}, "many": ["x"] * 1000, "tuple": (np.eye(2), np.ones(2)), "two words": "a b",
        "infinite numbers": np.full((2, 2), np.inf), "one": [1.0], "large number": 1e300,
        "names": ["x[0]", "x[1]"], "name": "x[0]", "to number": {"x[0]": 1.0},
        "to cube": {"x[0]": np.ones((2, 2, 2))}, "to text": {"x[0]": "rad"},
        "to object": {"x[0]": object()}, "by number": {1: 1.0},
        "to raising": {"x[0]": raising("__float__", "__array__")},
        "raising items": [raising("__float__", "__array__", "__str__", "__index__")],
        **{f"raises in {'-'.join(names)}": raising(*names) for names in _CONVERSIONS},
        "raising text": raising("__str__", "__len__", "__hash__", base=str)("x[0]"),
        "raising array": raising("__array__", "__len__", base=np.ndarray)((2, 2)),
        "raising number": raising("__float__", "__index__", "__int__", base=float)(1.0),
        "raising list": raising("__iter__", "__len__", "__getitem__", base=list)([1.0, 2.0]),
        "raising dictionary": raising("__iter__", "items", "keys", base=dict)({"x[0]": 1.0}),
        "raising tuple": raising("__iter__", "__len__", base=tuple)((1.0, 2.0)),
    }  # fmt: skip


#: Python's ways to ask an object for a value; each set of them is one object that raises in all.
_CONVERSIONS = (
    ("__array__",), ("__float__",), ("__index__",), ("__fspath__",), ("__len__", "__iter__"),
    ("__iter__",), ("__getitem__", "keys"), ("__bool__",), ("__str__", "__repr__"), ("__eq__",),
    ("__hash__",), ("__getattr__",), ("__class__",), ("shape",), ("dtype", "ndim"), ("A", "B"),
    ("__array__", "__float__", "__len__", "__iter__", "__fspath__", "__str__", "__repr__"),
)  # fmt: skip


def raising(*names: str, base: type = object) -> Any:
    """An object (with another `base` its class) that raises in each of these methods."""

    def fail(*_: object) -> None:
        raise RuntimeError("this object has no value\nof any kind")

    fixed = ("shape", "dtype", "ndim", "A", "B", "__class__")
    made = {name: property(fail) if name in fixed else fail for name in names}
    found: Any = type("Raising", (base,), made)
    return found() if base is object else found


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
    table = {
        "source": "s",
        "columns": columns,
        "units": {"y": "m"},
        "skipped": {"z": "is text"},
        "rate": 10.0,
        "notes": ("none",),
    }
    return [
        (impc.make_table, table),
        (impc.read_table, {"path": trial, "largest": 10**6, "sheet": ""}),
        (impc.write_table, {"path": folder / "again.csv", "table": made}),
        (impc.read_configuration, {"path": lab}),
        (impc.read_recordings, {"paths": [trial], "configuration": settings, "plant": one}),
    ]


def _of_methods() -> list[Call]:
    """Methods of public classes, and functions of estimates."""
    v = values()
    law, two, box, trial = v["controller"], v["plant"], v["bounds"], v["recording"]
    shape, person = impc.Structure(two), impc.Observer(two, ["x[0]"], sensory=0.1)
    family, point, found = v["family"], v["point"], v["estimate"]
    start = {"theta": {"price": 1.0}, "x0": [1.0], "mu": 1e-9}
    push, size = np.zeros((30, 1)), np.ones(2)
    commanded = impc.Recording(two, trial.outputs, trial.disturbance, commands=v["simulation"].u)
    continuous = impc.Plant(
        control.c2d(control.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0), 0.1)
    )
    return [
        (impc.Controller.from_continuous_gain, {
            "plant": continuous, "gain": [[4, 3]], "bounds": impc.Bounds(continuous), "horizon": 5,
            "metric": [[1]], "terminal_set": True, "softening": None, "solver": "compiled",
        }),
        (v["open"].simulate, {
            "x0": size, "steps": 30, "disturbance": push, "target": {"y[0]": 0.1},
        }),
        (two.unit, {"name": "x[0]"}), (two.word, {"name": "x[0]"}),
        (two.direction, {"name": "x[0]"}), (two.drawing, {"states": np.ones((3, 2))}),
        (shape.weights, {"z": np.zeros(3)}), (shape.changes, {"z": np.zeros(3)}),
        (shape.reported, {"z": np.zeros(3)}),
        (person.with_levels, {"levels": person.levels}), (person.names, {"plant": two}),
        (family.values, {"logarithms": np.zeros(1)}),
        (family.part, {"chosen": np.array([True]), "logarithms": np.zeros(1)}),
        (family.wider, {
            "names": ["more"], "nominal": [1.0], "deviations": [0.1], "change": lambda one, _: one,
        }),
        (family.with_delay, {"deviation": 0.1, "dt": 0.1}),
        (family.with_limits, {"plant": two, "bounds": box}), (family.limits, {"plant": two}),
        (family.bounds_at, {"plant": two, "bounds": box, "logarithms": np.zeros(1)}),
        (v["problem"].leaving_out, {"trial": 0}),
        (v["problem"].at, {
            "starts": v["problem"].starts, "logarithms": np.zeros(0), "errors": v["problem"].errors,
        }),
        (v["terminal"].contains, {"x": size}),
        (v["terminal"].project, {"first": 0, "second": 1}),
        (impc.ImpcError("a", "b", "c").at, {"file": "a"}),
        (point.with_horizon, {"horizon": 3}), (point.values, {"theta": {"price": 1.0}}),
        (v["wide point"].with_known, {"known": {"price": 1.0}}),
        (point.closed_loop, {**start, "steps": 2, "d": np.zeros((2, 0)), "solver": "ipopt"}),
        (point.recorded_plan, {
            "x": np.ones((3, 1)), "u": np.ones((2, 1)), "d": np.zeros((2, 0)), "x0": [1.0],
            "unknown_start": True,
        }),
        (point.recorded_loop, {
            "x": np.ones((3, 1)), "u": np.ones((2, 1)), "d": np.zeros((2, 0)), "x0": [1.0],
            "unknown_start": False,
        }),
        (impc.OptimalControlProblem, v["point arguments"]),
        (found.simulate, {"x0": size, "steps": 30, "disturbance": push}),
        (found.plot, {"trial": 0, "axes": None}),
        (found.save, {"path": Path(_FOLDER.name, "found.json")}),
        (impc.load, {"path": _saved(), "plant": two, "family": None}),
        (impc.command_regression, {"estimate": impc.fit(impc.Problem(two, box, 4, [commanded]))}),
        (impc.report, {"estimate": found, "folder": Path(_FOLDER.name, "page"), "settings": None}),
        (impc.FitSettings, vars(impc.FitSettings())),
        (impc.fit_problem, {
            "plant": two, "recordings": [trial], "family": None,
            "settings": impc.FitSettings(horizon=3, u_max=1.0, settle=0.0),
        }),
        (impc.fit_output_feedback, {
            "found": found, "observer": person, "recorder": size, "spread": 1.0,
            "max_evaluations": 1, "held": ["motor"], "counted": 0,
        }),
        (impc.mpc_function, {"controller": law}),
        (impc.closed_loop_function, {
            "controller": law, "steps": 3, "disturbance": np.zeros((3, 1)), "of": "gain",
        }),
        (impc.simulate_and_differentiate, {
            "controller": law, "given": v["scenario"], "along": impc.directions(law, 2),
        }),
        (impc.with_rates, {"plant": two}), (impc.replace, {"value": box, "u_max": size}),
        (impc.PlantFamily, {
            "make": lambda _: two, "names": ["mass"], "nominal": [1.0],
            "uncertainty": {"mass": "5 %"}, "slopes": lambda _: {},
        }),
        (impc.Plant, {
            "system": v["system"], "controls": None, "units": {"x[0]": "m"},
            "words": {"x[0]": "place"}, "body": None,
        }),
        (impc.steady_state, {
            "plant": two, "target": {"y[0]": 1.0}, "disturbance": [0.1], "bounds": box,
        }),
        (impc.Recording, {
            "plant": two, "outputs": trial.outputs, "finer": trial.disturbance,
            "timing": {"y[0]": 0.01},
        }),
        (impc.Problem, {
            "plant": two, "bounds": box, "horizon": 4, "recordings": [trial],
            "signal_errors": {"offset": ["y[0]"]}, "structure": shape, "feedback_states": ["x[0]"],
            "solver": "compiled", "terminal_weight": np.eye(2),
        }),
        (impc.Structure, {"plant": two, "Q": ["x[0]", "x[1]"], "R": "diagonal"}),
        (impc.Structure, {"plant": two, "Q": "full", "over": ["x[0]", "x[1]"]}),
    ]  # fmt: skip


@cache
def _saved() -> Path:
    found: Path = values()["estimate"].save(Path(_FOLDER.name, "saved.json"))
    return found


def calls() -> list[Call]:
    """A right call of every public function: name by name, all required and optional arguments."""
    v = values()
    K, S, states, size = v["solution"].K, v["solution"].S, np.eye(2), np.ones(2)
    two, box, pair, trial = v["plant"], v["bounds"], v["weights"], v["recording"]
    problem, about = {"problem": v["problem"]}, {"plant": two, "gain": K}
    made = {"bounds": box, "horizon": 4, "terminal_set": True, "softening": 1e6}
    solved = {**made, "solver": "compiled"}
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
        (impc.Controller, {"plant": two, "weights": pair, **solved}),
        (impc.Controller, {"plant": two, "weights": pair, **own}),
        (impc.Controller.from_gain, {**about, **solved, "metric": S, "near": v["terminal"]}),
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
        (impc.least_condition_weights, {"fibre": v["fibre"], "member": pair}),
        (impc.other_weights, {"fibre": v["fibre"], "count": 2, "condition_ratio": 10.0}),
        (impc.inverse_lqr_lmi, about),
        (impc.inverse_lqr_gradient, {**about, "start": pair, "max_evaluations": 3}),
        (impc.table_3_1, {**problem, "absolute": False, "progress": str}),
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
            "evaluations": 3, "starts": 1, "solver": "ipopt",
        }),
        (impc.Label, {"subject": "a", "visit": "b", "condition": "c", "trial": "d"}),
        *_of_methods(),
        *map(changed, (two, box, trial, v["controller"], v["problem"], v["terminal"])),
    ]  # fmt: skip
