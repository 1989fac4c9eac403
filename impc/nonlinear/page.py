"""Report of a fitted optimal control problem: verdict, movement, parameters, result.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from impc.arrays import Frozen
from impc.inverse.estimates import Status
from impc.levels import Level
from impc.nonlinear.combinations import interval
from impc.nonlinear.fit import OptimalControlEstimate
from impc.nonlinear.search import Residuals
from impc.reporting.document import Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, sentence_case
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.shown_units import shown_as
from impc.reporting.style import panels
from impc.reporting.verdict import Key

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Number of recordings of which every sample is written.
MOST_TRIALS = 6
# A row counts as at its limit within this share of its largest value. An active row with a
# multiplier lam stays at a distance of 1e-10 / lam.
_AT_LIMIT = 1e-5
_EXACT = 1e-9
_LITTLE = 50.0  # VAF in % below which a signal counts as not explained
_LEVEL = 0.95
_MOST_PANELS = 4  # of the figure
_ENDS = {"low": "95 % CI low", "high": "95 % CI high"}
#: Name among the methods of result.json.
METHOD = "nonlinear_inverse_mpc"


@dataclass(frozen=True, eq=False)
class OptimalFit(Frozen):
    """An estimate and the origin of its recordings."""

    estimate: OptimalControlEstimate
    trials: tuple[str, ...]  # name of each recording
    findings: tuple[tuple[str, ...], ...]  # findings of the file checks of each
    dt: float | None = None  # sample time in s, if known
    known: Mapping[str, tuple[float, str]] = field(default_factory=dict)  # fixed: value and unit
    settings: Mapping[str, Any] = field(default_factory=dict)  # as the user gave them

    @property
    def vaf(self) -> dict[str, float]:
        """VAF of each measured signal, %."""
        found = signal_vaf(self.estimate).items()
        return {name: value for name, value in found if np.isfinite(value)}

    @property
    def poor(self) -> list[str]:
        """Signals that are not explained."""
        return [name for name, value in self.vaf.items() if value < _LITTLE]

    @property
    def explained(self) -> str:
        """VAF of each signal in words."""
        each = ", ".join(f"{_words(name)} {number(one, 4)} %" for name, one in self.vaf.items())
        return f"Variance accounted for: {each}"

    @property
    def open(self) -> list[str]:
        """Parameters that are not identified."""
        found = self.estimate.combinations.unidentified
        return list(dict.fromkeys(key for one in found for key in one.exponents))

    @property
    def usable(self) -> bool:
        """Whether a value may be reported."""
        found = self.estimate
        return bool(found.settled and not self.poor and found.combinations.identified)


def signal_vaf(estimate: OptimalControlEstimate) -> dict[str, float]:
    """VAF of each state and input over all recordings in %; NaN where nothing was measured."""
    recorded = np.vstack([np.hstack([one.x[1:], one.u]) for one in estimate.recordings])
    simulated = np.vstack([np.hstack([x[1:], u]) for x, u in estimate.runs])
    size = np.nansum(recorded**2, axis=0)
    left = np.nansum((recorded - simulated) ** 2, axis=0)
    values = 100 * (1 - np.divide(left, size, out=np.full_like(size, np.nan), where=size > 0))
    names = (*estimate.problem.state_names, *estimate.problem.input_names)
    return dict(zip(names, map(float, values), strict=True))


def reached(estimate: OptimalControlEstimate) -> pd.DataFrame:
    """Number of samples at which each path constraint is at its limit, in the estimate's runs."""
    heads, rows = ["constraint", "at_its_limit", "samples"], estimate.problem.rows
    if not rows:
        return pd.DataFrame(columns=heads)
    theta = list(estimate.theta.values())
    values = np.array([
        estimate.problem.functions[3](*sample, theta).full().ravel()
        for one, (x, u) in zip(estimate.recordings, estimate.runs, strict=True)
        for sample in zip(x[:-1], u, one.d, strict=True)
    ])  # fmt: skip
    size = np.max(np.abs(values), axis=0, initial=1e-300)
    at_limit = pd.DataFrame(values > -_AT_LIMIT * size)
    owners = at_limit.T.groupby([row.partition("[")[0] for row in rows], sort=False)
    counts = owners.any().sum(axis=1)
    found = [(name, int(count), len(values)) for name, count in counts.items()]
    return pd.DataFrame(found, columns=heads)


_EXPLAINS = Kind[OptimalFit](
    Level.GREEN, always, "The problem explains this movement, and each parameter is identified.",
    "{explained}.",
)  # fmt: skip
RULES = Rules[OptimalFit](
    {
        "poor": lambda it: ", ".join(_words(name) for name in it.poor),
        "open": lambda it: ", ".join(it.open),
        "names": lambda it: ", ".join(one.name for one in it.estimate.combinations.identified),
        "each": lambda it: " ".join(one.sentence for one in it.estimate.combinations.unidentified),
    },
    kinds=(
        Kind(Level.RED, lambda it: not it.estimate.settled,
             "The search stopped before it converged.", "Do not use its parameters."),
        Kind(Level.RED, lambda it: it.poor,
             "The problem explains less than half of this movement.",
             "This concerns {poor}: equations, cost or limits do not fit the recordings."),
        replace(
            _EXPLAINS, level=Level.RED, when=lambda it: not it.estimate.combinations.identified,
            headline="The problem explains this movement, but no parameter is identified.",
        ),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: it.open,
            headline="The problem explains this movement, but {open} cannot be determined.",
            title="Some parameters are not identified", found="{each}",
            means="Other values of these parameters lead to the same movement.",
            todo=("Report the products that are identified, with their intervals.",
                  "Fix one of these parameters, or record a movement that depends on it."),
        ),
        replace(
            _EXPLAINS, level=Level.AMBER, when=lambda it: len(it.trials) == 1,
            title="One recording cannot check itself",
            found="All parameters were fitted to one recording, and none is left to predict.",
            means="The problem may explain this movement and not the next one.",
            todo=("Record at least two movements, and fit them together.",
                  "Report the parameters with their intervals as those of one movement."),
        ),
        _EXPLAINS,
    ),
    may=(
        Line(lambda it: it.usable, "Identified values, with their intervals.", "{names}."),
    ),
    may_not=(
        Line(lambda it: it.usable and it.open, "Values that are not identified.", "{open}."),
        Line(lambda it: it.usable, "How well other movements are predicted.",
             "No recording was left out."),
        Line(lambda it: it.usable, "This cost is the only one.",
             "Another form may explain the movement too."),
    ),
)  # fmt: skip


def _words(name: str) -> str:
    return name.replace("_", " ")


def estimate_report(estimate: OptimalControlEstimate, provenance: Provenance) -> Report:
    """Report, tables and figures of an estimate from Python, for `impc.report`."""
    names = tuple(f"recording {index + 1}" for index in range(len(estimate.recordings)))
    fit = OptimalFit(estimate, names, ((),) * len(names), estimate.problem.dt)
    return optimal_report(fit, provenance)


def optimal_report(fit: OptimalFit, provenance: Provenance) -> Report:
    """Report, result.json, tables of parameters, products and samples, and the figure."""
    estimate, problem = fit.estimate, fit.estimate.problem
    verdict, table, limits = RULES.verdict(fit), _parameters(fit), reached(estimate)
    count, alone = len(estimate.theta), int(np.sum(np.isfinite(estimate.combinations.deviations)))
    lowest = min(fit.vaf.values(), default=0.0)
    keys = [
        Key(number(lowest, 4), "%", "lowest VAF of a signal"),
        Key(str(alone), f"of {count}", "parameters identified"),
        *(Key(str(row.at_its_limit), f"of {row.samples} samples", f"at limit of {row.constraint}")
          for row in limits.nlargest(1, "at_its_limit").itertuples()),
    ]  # fmt: skip
    given = {"Problem": provenance.plant_name, **provenance.plant_arguments, **fit.settings}
    own = [(sentence_case(_words(key)), Markup("<code>{}</code>").format(value))
           for key, value in given.items() if value not in (None, "")]  # fmt: skip
    values = "; ".join(f"{row[0]} {row[1]} {row[4]} (95 % CI {row[2]} to {row[3]})"
                       for row in table.rows[:count] if row[5] != "no")  # fmt: skip
    notes = " ".join(f"{name}: {'; '.join(one)}." for name, one in
                     zip(fit.trials, fit.findings, strict=True) if one)  # fmt: skip
    search = f"{sentence_case(_status(estimate).value)} after {estimate.evaluations} evaluations."
    checks = [
        Check(Level.GREEN if estimate.settled else Level.RED, "Search", search),
        Check(Level.NOTE if notes else Level.GREEN, "Recordings", notes or "No notes."),
    ]
    recordings = f"{len(fit.trials)} recording{'s' * (len(fit.trials) > 1)}"
    methods = (
        f"An optimal control problem over {problem.horizon} samples with {count} parameters was "
        f"fitted to {recordings} by nonlinear least squares."
    )
    return Report(
        f"impc fit: {provenance.plant_name}",
        "fit report",
        verdict,
        [
            Section("Parameters", [table, _combinations(fit)]),
            Section("Checks", [Checks(checks)]),
            Section("Provenance", [Terms([*provenance.terms, *own])]),
        ],
        ["Optimal control problem", recordings, provenance.made[:10]],
        Picture("movement", "Recorded and modelled signals over time",
                f"Grey: recorded; blue: model, from the first state only ({fit.trials[0]})."),
        keys,
        {"movement": lambda: _draw_movement(fit)},
        Copy(methods, f"{fit.explained}. {values}.") if fit.usable
        else "There is no text to copy: no value may be reported.",
        beside=[_samples(fit), Finding("limits", limits, "Samples at a limit.")],
        data=_data(fit, provenance),
        provenance=provenance,
    )  # fmt: skip


def _status(estimate: OptimalControlEstimate) -> Status:
    """Status of the search."""
    size = Residuals(estimate.problem, estimate.recordings, "", estimate.scales).size
    if float(estimate.residual @ estimate.residual) <= _EXACT**2 * size:
        return Status.EXPLAINED
    return Status.SETTLED if estimate.settled else Status.STOPPED


def _draw_movement(fit: OptimalFit) -> Figure:
    """Draw the first signals of the first recording over time."""
    problem, one, (x, u) = fit.estimate.problem, fit.estimate.recordings[0], fit.estimate.runs[0]
    pairs = [*zip(one.x.T, x.T, strict=True), *zip(one.u.T, u.T, strict=True)]
    names = (*problem.state_names, *problem.input_names)
    signals = []
    for name, (recorded, modelled) in zip(names, pairs, strict=True):
        if np.any(np.isfinite(recorded)):
            factor, unit = shown_as(problem.units.get(name, "-"))
            title = f"{sentence_case(_words(name))} ({unit})"
            signals.append((title, factor * recorded, factor * modelled))
    label = "Sample (-)" if fit.dt is None else "Time (s)"
    return panels(signals[:_MOST_PANELS], fit.dt or 1.0, label)


def _parameters(fit: OptimalFit) -> Finding:
    estimate, units = fit.estimate, fit.estimate.problem.units
    ends, found = estimate.intervals(_LEVEL), estimate.combinations
    identified = {one.name: one.identified for one in found.identified}
    identified |= {name: "no" for one in found.unidentified for name in one.exponents}
    rows = [
        (name, value, *ends[name], units.get(name, ""), identified.get(name, "yes"),
         estimate.start[name])
        for name, value in estimate.theta.items()
    ]  # fmt: skip
    rows += [(name, value, np.nan, np.nan, unit, "known", np.nan)
             for name, (value, unit) in fit.known.items()]  # fmt: skip
    heads = ["parameter", "value", "low", "high", "unit", "identified", "start"]
    return Finding("parameters", pd.DataFrame(rows, columns=heads), labels=_ENDS)


def _combinations(fit: OptimalFit) -> Finding:
    found, free = fit.estimate.combinations, {True: "any factor", False: "near these values"}
    rows = [
        (one.name, one.value, *interval(one.value, one.deviation, one.difference, _LEVEL),
         one.identified, free[one.scaling] if one.identified == "no" else "")
        for one in (*found.identified, *found.unidentified)
    ]  # fmt: skip
    heads = ["product", "value", "low", "high", "identified", "free"]
    table = pd.DataFrame(rows, columns=heads)
    return Finding("combinations", table, folded="Products of parameters", labels=_ENDS)


def _samples(fit: OptimalFit) -> Finding:
    """Table with one row per sample: recorded and simulated signals, and disturbances."""
    problem, tables = fit.estimate.problem, []
    names = {"x": problem.state_names, "u": problem.input_names, "d": problem.disturbance_names}
    runs = zip(fit.trials, fit.estimate.recordings, fit.estimate.runs, strict=True)
    for trial, one, (x, u) in [*runs][:MOST_TRIALS]:
        clock = {"sample" if fit.dt is None else "time": (fit.dt or 1.0) * np.arange(len(x))}
        blocks = [("x", one.x, "_recorded"), ("x", x, "_simulated"), ("u", one.u, "_recorded"),
                  ("u", u, "_simulated"), ("d", one.d, "")]  # fmt: skip
        parts = [pd.DataFrame(values, columns=names[kind]).add_suffix(end)
                 for kind, values, end in blocks]  # fmt: skip
        tables.append(pd.concat([pd.DataFrame({"trial": trial, **clock}), *parts], axis=1))
    return Finding("trajectories", pd.concat(tables, ignore_index=True))


def _data(fit: OptimalFit, provenance: Provenance) -> dict[str, Any]:
    estimate, problem, found = fit.estimate, fit.estimate.problem, fit.estimate.combinations
    trials = zip(fit.trials, estimate.recordings, fit.findings, strict=True)
    kept = ("name", "exponents", "value", "deviation")
    return {
        "sentences": found.sentences,
        "combinations": {kind: [{key: getattr(one, key) for key in kept}
                                for one in getattr(found, kind)]
                         for kind in ("identified", "unidentified")},
        "singular_values": found.singular_values,
        "loss": estimate.loss,
        "x0": estimate.x0,
        "trials": [
            {"trial": name, "samples": len(one.u), "closed_loop": one.closed_loop, "findings": said}
            for name, one, said in trials
        ],
        "methods": {METHOD: {
            "status": _status(estimate).value,
            "misfit": float(np.linalg.norm(estimate.residual)),
            "evaluations": estimate.evaluations,
            "seconds": estimate.seconds,
            "vaf": signal_vaf(estimate),
        }},
        "problem": {
            "name": provenance.plant_name, "arguments": dict(provenance.plant_arguments),
            "states": problem.state_names, "inputs": problem.input_names,
            "disturbances": problem.disturbance_names, "horizon": problem.horizon, "dt": fit.dt,
        },
        "settings": dict(fit.settings),
    }  # fmt: skip
