"""Report of a sweep: where inverse LQR is biased."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from impc.levels import Level
from impc.reporting.document import Check, Checks, Copy, Report, Section, Terms
from impc.reporting.finding import Finding, Picture
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import number
from impc.reporting.rules import Kind, Line, Rules, always
from impc.reporting.style import BLUE, GREEN, HALF, MUTED, VERMILLION, new_figure, plain_log
from impc.reporting.verdict import Key
from impc.studies.example.sweep import (
    CONDITIONS,
    SWEPT,
    Sweep,
    biased_from,
    compared,
)
from impc.studies.methods_table import method_label, methods_fold

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The inverse LQR method of the headline: the one with the smallest errors.
_BEST = "inverse_lqr_output"
_STYLES = dict(
    zip(SWEPT, ((BLUE, "o", "-"), (VERMILLION, "s", "--"), (GREEN, "^", ":"), (MUTED, "D", "-.")),
        strict=True)
)  # fmt: skip
# Smallest error that is drawn, %: exact recordings leave rounding errors.
_ROUNDING = 1e-3
_SETTING = (
    "A controller with known weights is simulated under random pushes. Its limit is set so that "
    "the given share of the samples is at it, for each seed. The error of a gain is that of the "
    "command it asks for without a limit, over the true states, relative to the true command."
)
_TEST = (
    "At each level, a one-sided sign test over the seeds asks whether the error of inverse LQR "
    "exceeds that of inverse MPC (p_holm: corrected over the levels). Biased from: the least level "
    "from which it does at 5 %, at all higher ones too. Difference: median over the seeds, with an "
    "interval of at least 95 % without assumed distribution."
)


class Facts:
    """Sentences on each condition."""

    def __init__(self, sweep: Sweep) -> None:
        self.tests = compared(sweep.fits)
        self.start = {name: biased_from(self.tests, name, _BEST) for name in CONDITIONS}
        self.seeds, self.lost = sweep.fits["seed"].nunique(), len(sweep.failures)
        self.right = [name for name in ("exact", "noise") if self.start[name] is not None]
        self.wrong = [name for name in ("limit", "plant") if self.start[name] is not None]
        first = self.start["noise"]
        self.level = "" if first is None else f"{first['level_percent']:g} %"
        self.said = "" if first is None else self.sentence("noise")

    def sentence(self, condition: str) -> str:
        """From which level inverse LQR is biased under a condition, with the evidence."""
        row, name = self.start[condition], CONDITIONS[condition]
        if row is None:
            return f"{name}: no level from which inverse LQR has larger errors than inverse MPC."
        own = self.tests[(self.tests["condition"] == condition) & (self.tests["method"] == _BEST)]
        below = own.loc[own["level_percent"] < row["level_percent"], "level_percent"]
        after = f", not at {below.max():g} %" if len(below) else ""
        ends = f"{number(row['low'])} to {number(row['high'])}"
        return (
            f"{name}: biased from {row['level_percent']:g} % of the samples at the limit{after}; "
            f"there its error is {number(row['inverse_lqr_percent'])} %, that of inverse MPC "
            f"{number(row['inverse_mpc_percent'])} % (difference 95 % CI {ends} percentage points, "
            f"larger in {row['larger']} of {row['fits']} seeds, "
            f"p_holm = {number(row['p_holm'], 2)})."
        )


_BIASED = Kind[Facts](
    Level.GREEN, always,
    "Inverse LQR is biased from {level} of the samples at the limit.", "{said}", badge="Shown",
)  # fmt: skip
RULES = Rules[Facts](
    {},
    kinds=(
        Kind(
            Level.AMBER, lambda it: not it.level,
            "No level was found from which inverse LQR is biased.",
            title="The sweep does not separate the methods",
            found="With noise, no level and all above it reach p_holm < 0.05 with {seeds} seeds.",
            means="The difference is small, or there are too few seeds: five levels need seven.",
            todo=("Run it again with more --seeds.",),
            badge="Not shown",
        ),
        _BIASED,
    ),
    may=(
        Line(lambda it: it.level, "From which level inverse LQR is biased on this plant.",
             "Right plant and limit, noise of 5 %: {level} of the samples, {seeds} seeds."),
    ),
    may_not=(
        Line(always, "The level for another plant.",
             "It depends on plant, horizon, weights and pushes; this one is simulated."),
        Line(lambda it: len(it.wrong) < 2, "That inverse MPC is better with any model.",
             "A wrong limit or plant biases it too; see the panels."),
    ),
)  # fmt: skip


def sweep_report(sweep: Sweep, title: str, provenance: Provenance) -> Report:
    """Report of `impc example --sweep`."""
    facts = Facts(sweep)
    verdict, count = RULES.verdict(facts), len(sweep.fits) // len(SWEPT)
    without = sweep.fits[sweep.fits["error_percent"].isna()].groupby("method").size()
    lost = [f"{method_label(str(name))}: {times} of {count}." for name, times in without.items()]
    checks = [
        Check(Level.AMBER if facts.lost else Level.GREEN, "Recordings",
              " ".join(sweep.failures) or f"All {count} recordings were simulated."),
        Check(Level.NOTE, "Fits without a gain", " ".join(lost) or "None."),
    ]  # fmt: skip
    return Report(
        "impc example --sweep",
        "sweep",
        verdict,
        [
            Section("Conditions", [_levels(facts), *map(facts.sentence, CONDITIONS)]),
            Section("Tests", [_tests(facts.tests)]),
            Section("Checks", [Checks(checks)]),
            Section("How it is done", [_SETTING, _TEST, methods_fold(SWEPT)]),
            Section("Provenance", [Terms(provenance.terms)]),
        ],
        meta=("Simulation", title, f"{facts.seeds} seeds"),
        hero=Picture(
            "sweep",
            "Error of the gain over the share of samples at the limit, four conditions",
            "Median error over the seeds (logarithmic axis); bars: quartiles. Lower is better.",
        ),
        keys=_keys(facts),
        figures={"sweep": partial(sweep_figure, sweep.fits)},
        copy=Copy(f"{_SETTING} {_TEST}", " ".join(map(facts.sentence, CONDITIONS))),
        beside=[Finding("fits", sweep.fits, "Row: one fit.")],
        data={"levels": sorted(sweep.fits["level_percent"].unique()), "seeds": facts.seeds,
              "biased_from_percent": {
                  name: None if row is None else row["level_percent"]
                  for name, row in facts.start.items()}},
        provenance=provenance,
    )  # fmt: skip


def _keys(facts: Facts) -> list[Key]:
    said = {"noise": "right model, noise", "limit": "limit 20 % too low",
            "plant": "plant 10 % wrong"}  # fmt: skip
    return [
        Key("-" if row is None else f"{row['level_percent']:g}", "% at the limit",
            "inverse LQR is biased from", f"{words}" + (": at no level" if row is None else ""))
        for name, words in said.items() for row in [facts.start[name]]
    ]  # fmt: skip


def _levels(facts: Facts) -> Finding:
    """Table: level from which each inverse LQR method is biased, per condition."""
    import pandas as pd  # noqa: PLC0415  # a third of a second

    rows = []
    for name, title in CONDITIONS.items():
        found = {one: biased_from(facts.tests, name, one) for one in SWEPT[1:]}
        levels = {f"{one}_percent": np.nan if row is None else float(row["level_percent"])
                  for one, row in found.items()}  # fmt: skip
        rows.append({"condition": title} | levels)
    heads = {f"{one}_percent": f"{method_label(one)} (%)" for one in SWEPT[1:]}
    caption = "Share of samples at the limit from which each method is biased; a dash: at none."
    return Finding("levels", pd.DataFrame(rows), caption, labels=heads, digits=2)


def _tests(tests: pd.DataFrame) -> Finding:
    return Finding(
        "tests", tests, _TEST, digits=3,
        folded=f"All {len(tests)} tests",
        labels={"level_percent": "At limit (%)", "inverse_mpc_percent": "Inverse MPC (%)",
                "inverse_lqr_percent": "Inverse LQR (%)", "low": "95 % from", "high": "to",
                "p_holm": "p_holm"},
        hidden=["p"],
    )  # fmt: skip


def sweep_figure(fits: pd.DataFrame) -> Figure:
    """Median error of each method over the level, one panel per condition."""
    figure = new_figure(HALF, 6.2)
    axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for ax, (name, title) in zip(axes, CONDITIONS.items(), strict=True):
        _panel(ax, fits[fits["condition"] == name])
        ax.set_title(title)
    drawn = np.clip(fits["error_percent"].dropna(), _ROUNDING, None)
    axes[0].set_ylim(drawn.min() / 1.5, drawn.max() * 1.5)
    plain_log(axes[0].yaxis)
    for ax in axes[2:]:
        ax.set_xlabel("Samples at the limit (%)")
    for ax in axes[::2]:
        ax.set_ylabel("Error of the gain (%)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return figure


def _panel(ax: Axes, fits: pd.DataFrame) -> None:
    ax.set_yscale("log")
    for name, (color, marker, line) in _STYLES.items():
        cells = fits[fits["method"] == name].groupby("level_percent")
        error = cells["error_percent"]
        # Of half of the recordings at least: other medians are of the easier ones.
        known = (error.count() >= 0.5 * error.size()).to_numpy()
        low, middle, high = (
            np.clip(np.where(known, error.quantile(q), np.nan), _ROUNDING, None)
            for q in (0.25, 0.5, 0.75)
        )
        at = cells["at_limit_percent"].mean().to_numpy()
        ax.errorbar(at, middle, (middle - low, high - middle), color=color, marker=marker,
                    linestyle=line, elinewidth=0.8, label=method_label(name))  # fmt: skip
