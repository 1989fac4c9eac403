"""Report of a comparison of methods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impc.assess.assessments import MethodFit
from impc.checking import replace
from impc.inverse.estimates import Status
from impc.inverse.problem import Problem
from impc.levels import Level
from impc.reporting.document import Block, Check, Checks, Copy, Fold, Report, Section
from impc.reporting.exchange import long_finding
from impc.reporting.finding import Chart, Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number, sentence_case
from impc.reporting.verdict import Key
from impc.studies.charts import trajectories
from impc.studies.compare.verdict import RULES, Facts, name_of, needed, share
from impc.studies.methods_figure import by_score, first_fall, methods_figure, unexplained
from impc.studies.methods_table import (
    methods_finding,
    methods_fold,
    methods_long,
    problem_data,
    provenance_section,
    trajectory_table,
)

# Number of trials, from the first, whose trajectories are on the page.
_DRAWN = 6


def compare_report(
    problem: Problem, compared: Sequence[MethodFit], provenance: Provenance
) -> Report:
    """Report of `impc compare`."""
    subject = str(problem.recordings[0].label.subject) or "one person"
    found = compared[-1].estimate.problem.recordings  # with fitted offsets
    problem, facts = replace(problem, recordings=found), Facts(compared)
    verdict, count = RULES.verdict(facts), len(found)
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
            f"{facts.fitted} of {len(compared)} methods fitted",
            f"{count} trial{'s' * (count > 1)}, {number(seconds)} s",
        ),
        hero=Picture(
            "comparison",
            "Variance that each method leaves unexplained, and the largest command it needs",
            f"Left: unexplained variance in {facts.where}; farther left is better (logarithmic "
            "axis)." + (" Blue: stays within the limit. Shaded: beyond it." if facts.limit else ""),
        ),
        keys=_keys(facts),
        figures={"comparison": lambda: methods_figure(compared)},
        copy=verdict.sentence if verdict.level is Level.RED else _copy(facts, count),
        beside=[
            long_finding(methods_long(compared)),
            Finding("trajectories", sway, "Row: one sample."),
        ],
        data=problem_data(problem, compared),
        provenance=provenance,
    )


def _keys(facts: Facts) -> list[Key]:
    if not facts.ranked:
        return []
    best, other = facts.best, next(iter(facts.others), None)
    first = Key(share(best)[:-2], "%", "of the variance explained",
                f"{name_of(best)}, {facts.where}")  # fmt: skip
    value, _, unit = needed(facts.unbounded).partition(" ")
    limit = f"the limit is {facts.limit}" if facts.limit else "no limit"
    if other is None:
        beyond = Key(number(100 * best.exceeded), "% of the time", "beyond the limit")
        return [first, Key(value, unit, "largest command", limit), beyond]
    lead = number(unexplained(other) - unexplained(best))
    left = f"which leaves {facts.factor} times as much variance"
    whose = "best model without a limit" if facts.limit and facts.free else facts.against
    return [
        first,
        Key(lead, "percentage points", f"lead over the {facts.against}", left),
        Key(value, unit, f"needed by the {whose}", f"{name_of(facts.unbounded)}; {limit}"),
    ]


def _checks(facts: Facts, problem: Problem) -> list[Check]:
    count, good, note = len(problem.recordings), Level.GREEN, Level.NOTE
    odd = sum(bool(trial.findings) for trial in problem.recordings)
    falls = [(name_of(fit), first_fall(fit)) for fit in facts.fits]
    fallen = " ".join(f"{name}: stops at {at:.1f} s." for name, at in falls if not np.isnan(at))
    stopped = [name_of(f) for f in facts.fits if f.estimate.status is Status.STOPPED]
    ended = f"Not converged: {'; '.join(stopped)}." if stopped else "All searches converged."
    left_out, leads = "No trial was left out.", False
    if facts.held and facts.others:
        ahead = facts.best.held_out.mean(axis=1) > facts.others[0].held_out.mean(axis=1)
        leads = bool(np.all(ahead))
        left_out = f"The best model leads in {np.count_nonzero(ahead)} of {len(ahead)} trials."
    used = f"{count - odd} of {count} trials without problems."
    checks = [
        Check(Level.AMBER if odd else good, "Recordings", used),
        Check(good if leads else note, "Left-out trials", left_out),
        Check(note if fallen else good, "Simulations", fallen or "All simulations reach the end."),
        Check(Level.AMBER if stopped else good, "Searches", ended),
    ]
    for fit in facts.fits:
        doubts = fit.estimate.doubts if len(facts.fits) == 1 else ()
        # Without the remedy, which is for Python users
        for said in filter(None, (fit.estimate.reason.partition(";")[0], *doubts)):
            checks.append(Check(note, name_of(fit), f"{sentence_case(said).rstrip('.')}."))
    return checks


def _copy(facts: Facts, count: int) -> Copy:
    best, other = facts.best, next(iter(facts.others), None)
    trials = f"{count} trial{'s' * (count > 1)}"
    others = ", and to all trials except one, which they then predicted" if facts.held else ""
    results = f"{name_of(best)} explained {share(best)} of the variance in {facts.where}"
    if other is not None:
        results += f"; the {facts.against} explained {share(other)}"
        if facts.limit and facts.free:
            results += f". Without a limit, up to {needed(facts.unbounded)} were required, where "
            results += f"{facts.limit} was assumed to be available"
    models = "1 model was" if facts.fitted == 1 else f"{facts.fitted} models were"
    return Copy(
        f"{models} fitted to {trials}{others}. Agreement is variance accounted for (VAF), averaged "
        "over the recorded signals.",
        f"{results}.",
    )
