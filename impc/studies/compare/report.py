"""Report of a comparison of methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.checking import replace
from impc.inverse.estimates import Status
from impc.reporting.document import Block, Check, Checks, Copy, Fold, Report, Section
from impc.reporting.finding import Chart, Finding, Level, Picture
from impc.reporting.rendering import number
from impc.reporting.shown_units import signal_name
from impc.reporting.style import HALF
from impc.reporting.verdict import Alert, Claim, Key, Verdict
from impc.studies.charts import trajectories
from impc.studies.fit.facts import limits, with_unit
from impc.studies.methods_figure import (
    by_score,
    explained,
    first_fall,
    largest_commands,
    methods_figure,
    unexplained,
)
from impc.studies.methods_table import (
    controller_findings,
    method_label,
    methods_finding,
    methods_fold,
    problem_data,
    provenance_section,
    trajectory_table,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.assess.assessments import MethodFit
    from impc.inverse.problem import Problem
    from impc.reporting.provenance import Provenance

# VAF (%) below which a model is poor; ratio of unexplained variances above which it is worse.
_HALF, _WORSE = 50.0, 1.1
# Number of trials, from the first, whose trajectories are on the page.
_DRAWN = 6


class _Facts:
    """Ranking and labels that sentences and numbers share."""

    def __init__(self, fits: Sequence[MethodFit]) -> None:
        plant, bounds = fits[0].estimate.problem.plant, fits[0].bounds
        word = signal_name(plant, plant.controls[0]).removeprefix("commanded ")
        self.fits = fits
        # Methods that reach the end of every trial, best first
        self.ranked = [one for one in by_score(fits) if not np.any(np.isnan(explained(one)))]
        # For example "6 N m" (empty without limits) and "torque limit"
        self.limit = " and ".join(limits(plant, np.array(bounds.u_min), np.array(bounds.u_max)))
        self.word = f"{word} limit" if plant.m == 1 else "limit"
        # Best method that ignores the limits; without limits the second best
        free = [one for one in self.ranked if not _knows(one)]
        self.other = next(iter(free if self.limit else self.ranked[1:]), None)
        self.against = "best model without a limit" if self.limit else "next model"
        self.held = bool(self.ranked) and all(len(one.held_out) for one in self.ranked)
        self.where = "left-out trials" if self.held else "the fitted trials"

    @property
    def best(self) -> MethodFit:
        """Best method that reaches the end of every trial."""
        return self.ranked[0]

    @property
    def times(self) -> float:
        """Unexplained variance of the other method over that of the best."""
        return 1.0 if self.other is None else unexplained(self.other) / unexplained(self.best)


def compare_report(
    problem: Problem, compared: Sequence[MethodFit], provenance: Provenance
) -> Report:
    """Report of `impc compare`."""
    subject = str(problem.recordings[0].label.subject) or "one person"
    found = compared[-1].estimate.problem.recordings  # with fitted offsets
    problem, facts = replace(problem, recordings=found), _Facts(compared)
    verdict, count = _verdict(facts), len(found)
    ranked = [*by_score(compared), *(fit for fit in compared if fit.estimate.K is None)]
    files = provenance.files
    names = dict(enumerate(files if len(files) == count else map(str, range(1, count + 1))))
    drawn = trajectories(problem, ranked, dict(list(names.items())[:_DRAWN]))
    sway = trajectory_table(problem, names, {one.name: one.runs for one in ranked if one.runs})
    seconds = sum(trial.samples for trial in found) * problem.plant.dt
    chart = Fold(
        "Recorded signals, and simulations by each method from the start of the trial",
        [Chart("Trajectories", drawn)],
    )
    methods: list[Block] = [methods_finding(ranked), methods_fold(fit.name for fit in compared)]
    return Report(
        f"impc compare: {subject}",
        "comparison of methods",
        verdict,
        [
            Section("Methods", methods),
            Section("Trajectories", [chart]),
            Section("Checks", [Checks(_checks(facts, problem))]),
            provenance_section(problem, provenance),
        ],
        meta=(
            subject,
            f"{len(compared)} methods",
            f"{count} trial{'s' * (count > 1)}, {number(seconds)} s",
        ),
        hero=Picture(
            "comparison",
            "Variance that each method leaves unexplained, and the largest command it needs",
            f"Left: unexplained variance in {facts.where}; farther left is better (logarithmic "
            "axis)." + (" Blue: stays within the limit. Shaded: beyond it." if facts.limit else ""),
        ),
        keys=_keys(facts),
        figures={"comparison": lambda narrow: methods_figure(compared, narrow, HALF)},
        copy=_copy(facts, count) if verdict.level is Level.GREEN else verdict.sentence,
        beside=[*controller_findings(compared), Finding("trajectories", sway, "Row: one sample.")],
        data=problem_data(problem, compared),
        provenance=provenance,
    )


def _knows(fit: MethodFit) -> bool:
    """Whether the method takes the limits of the command into account."""
    return bool(np.any(np.isfinite(fit.estimate.problem.bounds.u_max)))


def _share(fit: MethodFit) -> str:
    return f"{100 - unexplained(fit):.2f} %"


def _needs(fit: MethodFit) -> str:
    """Largest command in words: "12.7 N m", or "210 % of a limit" for several commands."""
    value, _, label = largest_commands(fit)
    unit = label[label.rindex("(") + 1 : -1].replace("its limit", "a limit")
    return with_unit(number(value), unit)


def _verdict(facts: _Facts) -> Verdict:
    if not facts.ranked:
        headline = "No model follows these recordings to their end."
        said = "The simulations of every model stop before the end of a trial."
        return Verdict(Level.RED, headline, said)
    best, other = facts.best, facts.other
    sentence = f"“{method_label(best.name)}” explains {_share(best)} of the variance in "
    sentence += facts.where
    if other is not None:
        sentence += f", the {facts.against} {_share(other)} with up to {_needs(other)}"
    sentence += "."
    if float(np.min(explained(best))) < _HALF:
        poor = Claim("Which model is best.", "All explain less than half of a recorded signal.")
        headline = "No model explains half of every recorded signal."
        return Verdict(Level.RED, headline, sentence, may_not=[poor])
    level, headline = _headline(facts)
    alert = Alert(
        Level.AMBER,
        f"The {facts.word} does not agree with the recordings",
        f"“{method_label(best.name)}” explains most and needs up to {_needs(best)}; the limit was "
        f"given as {facts.limit}.",
        "The limit may be too low, or the person does not move like a controller with this limit.",
        [
            "Run impc fit with `unknown_limit = true`, which estimates the limit; compare again.",
            "Check body mass, height and the units of the recordings.",
        ],
    )
    same = "Any controller with the same commands moves identically."
    may_not = [
        Claim("Gains and cost weights.", "They have no intervals here; impc fit computes them."),
        Claim("That the person computes commands in this way.", same),
        *([] if facts.held else [Claim("How well a model predicts.", "No trial was left out.")]),
    ]
    alerts = [] if level is Level.GREEN else [alert]
    return Verdict(level, headline, sentence, alerts, _may(facts, level), may_not)


def _headline(facts: _Facts) -> tuple[Level, str]:
    best, limit, word = facts.best, facts.limit, facts.word
    if facts.other is None or not limit:
        return Level.GREEN, f"“{method_label(best.name)}” explains {_share(best)} of the variance."
    kept = [fit for fit in facts.ranked if fit.keeps_bounds]
    free = [fit.keeps_bounds for fit in facts.ranked if not _knows(fit)]
    if not best.keeps_bounds and (not kept or unexplained(kept[0]) > _WORSE * unexplained(best)):
        return Level.AMBER, f"The model that explains most needs more than {limit}."
    if all(free):
        return Level.GREEN, f"No model needs more than {limit}: the {word} does not matter here."
    if any(free):
        return Level.GREEN, f"A model that stays within the {word} of {limit} explains most."
    which = (
        f"Only models with a {word} fit" if len(kept) > 1 else f"Only a model with a {word} fits"
    )
    return Level.GREEN, f"{which} without exceeding {limit}."


def _may(facts: _Facts, level: Level) -> list[Claim]:
    best, other = facts.best, facts.other
    plant = best.estimate.problem.plant
    parts = zip(plant.outputs, explained(best), strict=True)
    each = ", ".join(f"{value:.2f} % ({signal_name(plant, name)})" for name, value in parts)
    which = "How much of the movement is explained."
    if other is not None:
        which = f"“{method_label(best.name)}” explains most."
    found = [Claim(which, f"{each} of {facts.where}.")]
    if other is not None and facts.limit and not other.keeps_bounds and level is Level.GREEN:
        much = f"leaves {number(facts.times, 2)} times as much variance unexplained and "
        why = f"The {facts.against} {much * (facts.times > _WORSE)}needs up to {_needs(other)}."
        found.append(Claim(f"The {facts.word} matters.", why))
    return found


def _keys(facts: _Facts) -> list[Key]:
    if not facts.ranked:
        return []
    best, other = facts.best, facts.other
    explains = f"{method_label(best.name)}, {facts.where}"
    first = Key(_share(best)[:-2], "%", "of the variance explained", explains)
    value, _, unit = _needs(other or best).partition(" ")
    limit = f"the limit is {facts.limit}" if facts.limit else "no limit"
    if other is None:
        beyond = Key(number(100 * best.exceeded), "% of the time", "beyond the limit")
        return [first, Key(value, unit, "largest command", limit), beyond]
    lead = number(unexplained(other) - unexplained(best))
    left = f"which leaves {number(facts.times, 2)} times as much variance"
    needs = f"{method_label(other.name)}; {limit}"
    return [
        first,
        Key(lead, "percentage points", f"lead over the {facts.against}", left),
        Key(value, unit, f"needed by the {facts.against}", needs),
    ]


def _checks(facts: _Facts, problem: Problem) -> list[Check]:
    count = len(problem.recordings)
    odd = sum(bool(trial.findings) for trial in problem.recordings)
    falls = [(method_label(fit.name), first_fall(fit)) for fit in facts.fits]
    fallen = " ".join(f"{name}: stops at {time:.1f} s." for name, time in falls if time is not None)
    stopped = [method_label(f.name) for f in facts.fits if f.estimate.status is Status.STOPPED]
    left_out, level = "No trial was left out.", Level.NOTE
    if facts.held and facts.other is not None:
        ahead = facts.best.held_out.mean(axis=1) > facts.other.held_out.mean(axis=1)
        level = Level.GREEN if np.all(ahead) else Level.NOTE
        left_out = f"The best model leads in {np.count_nonzero(ahead)} of {len(ahead)} trials."
    good, doubt, note = Level.GREEN, Level.AMBER, Level.NOTE
    ended = f"Not converged: {'; '.join(stopped)}." if stopped else "All searches converged."
    rows = [
        (
            doubt if odd else good,
            "Recordings",
            f"{count - odd} of {count} trials without problems.",
        ),
        (level, "Left-out trials", left_out),
        (note if fallen else good, "Simulations", fallen or "All simulations reach the end."),
        (doubt if stopped else good, "Searches", ended),
    ]
    for fit in facts.fits:
        doubts = fit.estimate.doubts if len(facts.fits) == 1 else ()
        # Without the remedy, which is for Python users
        for said in (fit.estimate.reason.partition(";")[0], *doubts):
            if said:
                text = f"{said[:1].upper()}{said[1:].rstrip('.')}."
                rows.append((note, method_label(fit.name), text))
    return [Check(*row) for row in rows]


def _copy(facts: _Facts, count: int) -> Copy:
    best, other = facts.best, facts.other
    others = ", and to all trials except one, which they then predicted" if facts.held else ""
    results = f"{method_label(best.name)} explained {_share(best)} of the variance in {facts.where}"
    if other is not None:
        results += f"; the {facts.against} explained {_share(other)}"
        if facts.limit:
            results += f" and required up to {_needs(other)}, where {facts.limit} was available"
    return Copy(
        f"{len(facts.fits)} models were fitted to {count} trials{others}. Agreement is variance "
        "accounted for (VAF), averaged over the recorded signals.",
        f"{results}.",
    )
