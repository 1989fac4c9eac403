"""Settings of the fit of an optimal control problem, as [fit] gives them (docs/nonlinear.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

from impc.errors import InputError, brief
from impc.files.configuration import FILL_IN
from impc.files.units import si_unit
from impc.nonlinear.solvers import require_solver
from impc.studies.fit.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.nonlinear.problem import OptimalControlProblem
    from impc.nonlinear.reading import OptimalTrial
    from impc.nonlinear.recordings import OptimalRecording


_MOST = {"evaluations": 100_000, "starts": 1000}


@dataclass(frozen=True)
class ParameterSettings:
    """A parameter of the problem: where its search begins, or its value."""

    start: float | None = None  # First value of a search
    known: float | None = None  # Its value, when it is not searched
    unit: str = ""  # Of the number; that of the problem where it is empty


@dataclass(frozen=True)
class OptimalFitSettings:
    """What a user may set of the fit of an optimal control problem."""

    # Every parameter of the problem by its name
    parameters: dict[str, ParameterSettings] = field(default_factory=dict)
    # Whether a recording is of a controller that plans anew at every sample, or is one plan
    recorded: Literal["loop", "plan"] = "loop"
    horizon: int | None = None  # In samples, in place of the problem's
    # Initial values of states, in SI units, in place of what was recorded
    x0: dict[str, float] = field(default_factory=dict)
    # Whether initial states are searched, from what was recorded of them and from `x0`
    unknown_start: bool = True
    solver: str = "ipopt"  # One of `impc.nonlinear.solvers.SOLVERS`
    evaluations: int = 200  # After how many a search is stopped
    starts: int = 5  # From how many starts, where the first explains little or has no plan


def optimal_fit_settings(table: Mapping[str, Any]) -> OptimalFitSettings:
    """Read the [fit] table of a configuration."""
    _require_filled_in("[fit]", table)
    given = table.get("parameters", {})
    known = [item.name for item in fields(ParameterSettings)]
    for name, item in given.items() if isinstance(given, dict) else ():
        place = f"[fit.parameters] {brief(name, 80)}"
        if not isinstance(item, dict):
            raise InputError(place, f"got {brief(item)}", "write it as in { start = 1.0 }")
        _require_filled_in(place, item)
        for key in item:  # msgspec passes over keys of inner tables
            if key not in known:
                raise InputError(f"{place}.{key}", "is not a setting", f"known: {', '.join(known)}")
    settings = read_settings("fit", OptimalFitSettings, table)
    for name, one in settings.parameters.items():
        if (one.start is None) == (one.known is None):
            raise InputError(
                f"[fit.parameters] {brief(name, 80)}",
                "has both start and known" if one.known is not None else "has no number",
                "give start for one that is searched, or known",
            )
    for key, most in _MOST.items():
        if not 1 <= getattr(settings, key) <= most:
            raise InputError(f"[fit] {key}", f"got {getattr(settings, key)}", f"give 1 to {most}")
    require_solver(settings.solver)
    return settings


def _require_filled_in(place: str, table: Mapping[str, Any]) -> None:
    for key, value in table.items():
        if value == FILL_IN:
            raise InputError(f"{place} {key}", f"is still {FILL_IN!r}", "fill it in")


def posed(
    problem: OptimalControlProblem, settings: OptimalFitSettings
) -> tuple[OptimalControlProblem, dict[str, float], dict[str, float]]:
    """The problem as it is fitted, where the search begins, and what is known; by name."""
    units = dict(zip(problem.parameter_names, problem.units, strict=True))
    for name in settings.parameters:
        if name not in units:
            remedy = f"it has {', '.join(units)}"
            raise InputError(
                f"[fit.parameters] {brief(name, 80)}", "is no parameter of the problem", remedy
            )
    start: dict[str, float] = {}
    known: dict[str, float] = {}
    for name, unit in units.items():
        one = settings.parameters.get(name)
        if one is None:
            raise InputError(f"[fit.parameters] {name}", "is missing", "give it start or known")
        factor = _factor(name, one.unit, unit)
        if one.known is not None:
            known[name] = factor * one.known
        elif one.start is not None:
            start[name] = factor * one.start
    if settings.horizon is not None:
        problem = problem.with_horizon(settings.horizon)
    return (problem.with_known(known) if known else problem), start, known


def _factor(name: str, written: str, expected: str) -> float:
    """From the unit that is written to that of the problem."""
    if not written:
        return 1.0
    unit = si_unit(written)
    if not expected:
        return unit.factor
    own = si_unit(expected)
    if own.base != unit.base:
        raise InputError(
            f"[fit.parameters] {name}.unit", f"is {written!r}, and the problem has {expected}",
            "correct the unit",
        )  # fmt: skip
    return unit.factor / own.factor


def recorded(
    problem: OptimalControlProblem, trial: OptimalTrial, settings: OptimalFitSettings
) -> OptimalRecording:
    """A file as a recording of the problem."""
    for name in settings.x0:
        if name not in problem.state_names:
            known = ", ".join(problem.state_names)
            raise InputError(f"[fit.x0] {brief(name, 80)}", "is no state", f"it has {known}")
    first = dict(zip(problem.state_names, trial.x[0], strict=True)) | settings.x0
    for name, value in first.items():
        if math.isnan(value):
            raise InputError(
                f"[fit.x0] {name}", "is missing, and was not recorded",
                "give it, or a guess with unknown_start = true",
            )  # fmt: skip
    make = problem.recorded_plan if settings.recorded == "plan" else problem.recorded_loop
    x0 = [first[name] for name in problem.state_names]
    return make(trial.x, trial.u, d=trial.d, x0=x0, unknown_start=settings.unknown_start)
