"""Page and figure of `experiments.steering`: who predicts best, and what is identified."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.stats

from experiments.reproduction.page import joined, table
from impc.arrays import Array
from impc.reporting.style import BLUE, GREEN, INK, MUTED, VERMILLION, drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATE, SETTLE, PERIOD = 60.0, 5.0, 1200
#: SHA-256 of all recordings of the public repository, and what each plant is.
DIGEST = "a9c70ae2c76cafbebe54d58f64882e745a8a59fc1457cb7b8858577cd5bf8727"
PLANTS = {"fo": "y' = u + d", "so": "y'' = u + d - y'"}
PI, REFITTED, OFFSET_FREE = "delayed PI", "delayed PI, fitted to these trials", "offset-free"
#: Methods of the tables and of the figure: label, marker, colour.
METHODS = (
    (PI, "s", VERMILLION),
    (REFITTED, "|", VERMILLION),
    ("inverse LQR", "x", MUTED),
    ("inverse MPC", "o", INK),
    ("offset-free inverse MPC", "D", BLUE),
    ("output feedback", "^", GREEN),
)
#: Least amplitude of a driven frequency relative to the largest.
_DRIVEN = 0.01
_HOW = {
    "delayed PI (fo), PID (so)": "gains on y, its integral and, for so, its rate, with one delay "
    "in whole samples, by least squares on y (shooting)",
    "the same, fitted to these trials": "the same structure fitted to the held-out trials: what it "
    "gains over the first row is the change of the person from trials p to trials m, and what a "
    "fit gains on its own trials",
    "inverse LQR": '`impc.fit(problem, "inverse_lqr")`: cost weights whose gain is that of the '
    "best unbounded controller, or near it; delay and lag of inverse MPC",
    "inverse MPC": "cost weights that fit cursor and slider; delay (Padé, order 2) and lag are "
    "free",
    "offset-free inverse MPC": "the same with `impc.with_observer`: the disturbance is learnt at a "
    "free rate",
    "output feedback": "`impc.fit_output_feedback`: y is sensed with noise and the disturbance is "
    "estimated as a random walk; delay and lag of the offset-free fit are fixed",
}
_DATA = """
## Data

Yamagami, Howell, Roth and Burden (CPHS 2018) published the recordings in the repository
EmDash00/CPHS2017 (commit f6537a0, experiment/data). They have no licence and are not part of the
project. Subjects hold a cursor y at zero with a slider u against a disturbance d, a sum of sines.
The plant is {plants}. Trials last 45 s at 60 Hz and contain two periods of 20 s. Plant and
disturbance are exact. The page uses every person with trials of this task (reference zero,
disturbance sos+A): {persons} persons, {count} pairs of person and plant. {known}

`python -m experiments.steering FOLDER` wrote this page in {seconds:.0f} s. Each method was fitted
to the first 3 trials with phases p, output feedback to the first one. Held out are all trials with
phases m. The disturbance of a trial m is that of its trial p with the opposite sign. A *new*
waveform is that of a trial m whose disturbance mirrors no fitted one.

## Prediction
"""
_SCORE = """
VAF is that of a simulation driven by the disturbance alone, in % over the last 40 s, mean of the
trials. The simulation starts at the recorded cursor with the hand at rest. The ceiling
(`impc.assess.ceiling`) is the part that repeats between the two periods. No bound is set, so
inverse MPC differs from LQR only in what is fitted. Classical inverse LQR approximates a gain and
not the movement: where the gain is not identified, a near gain can move differently or have no cost
weights. A VAF far below 0 means that this fit failed, and not that the model is rejected.
"""
_IDENTIFIED = """
## What is identified

Values of the offset-free fit with 95 % intervals. *Not identified* means that the interval is wider
than a factor of 10 or contains zero. Different combinations of gain, delay and lag move alike, so
that single numbers of a fit are no properties of a subject unless their interval is given.
"""
_RESPONSE = """
## Frequency response

Response of the slider to the disturbance at the frequencies of the sines, over the held-out trials,
mean over persons. The sign of the slider is inverted: gain 1 and phase 0 degrees cancel the
disturbance. Coherence is that of the recording: its complement is noise or nonlinearity. The models
have their gain over that of the recording, and their phase minus that of the recording in degrees.
"""


@dataclass(frozen=True)
class Fit:
    """One method on one person and plant; VAF in % of cursor and slider (trials, 2)."""

    label: str
    train: Array = field(default_factory=lambda: np.zeros((0, 2)))
    test: Array = field(default_factory=lambda: np.zeros((0, 2)))
    simulated: list[Array] = field(default_factory=list)  # Of each test trial (samples, 2)
    values: dict[str, str] = field(default_factory=dict)  # Fitted numbers, with intervals
    notes: tuple[str, ...] = ()  # Doubts in words
    reason: str = ""  # Why there is no controller
    seconds: float = 0.0

    def mean(self, column: int = 0) -> float:
        """Mean held-out VAF of the cursor (0) or slider (1), %; NaN without a controller."""
        return float(np.mean(self.test[:, column])) if len(self.test) else np.nan


@dataclass
class Case:
    """Recordings and fits of one person with one plant."""

    person: str
    kind: str
    train: list[Array]
    test: list[Array]
    unseen: list[bool]  # Whether a test disturbance mirrors no fitted one
    ceiling: Array | None = None  # Rows VAF, low and high; columns cursor and slider
    fits: list[Fit] = field(default_factory=list)
    warned: list[str] = field(default_factory=list)  # Python warnings of the fits

    @property
    def order(self) -> int:
        """Order of the plant."""
        return 1 if self.kind == "fo" else 2

    @property
    def title(self) -> str:
        """Person and plant."""
        return f"{self.person} {self.kind}"

    def named(self, label: str) -> Fit:
        """Fit of the method whose label begins so."""
        return next(one for one in self.fits if one.label.startswith(label))


def apart(case: Case, label: str, other: str = PI) -> Array:
    """Held-out VAF of the cursor by one method minus that by another (trials,), points."""
    return np.asarray(case.named(label).test[:, 0] - case.named(other).test[:, 0])


def interval(values: Array) -> tuple[float, float]:
    """Mean of some values and half its 95 % interval (Student's t)."""
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values)), float(scipy.stats.t.ppf(0.975, len(values) - 1) * error)


class Comparison(NamedTuple):
    """One method against another: counts of pairs, and differences in points."""

    better: int
    worse: int
    neither: int  # not clearly different
    median: float  # over pairs
    mean: float  # over persons, whose pairs are averaged first
    half: float  # half the 95 % interval of the mean
    persons: int

    def __str__(self) -> str:
        return (
            f"better in {self.better}, worse in {self.worse} and not clearly different in "
            f"{self.neither} of {self.better + self.worse + self.neither} pairs (median "
            f"{self.median:+.1f} points; mean of {self.persons} persons {self.mean:+.1f}, 95 % "
            f"interval {self.mean - self.half:+.1f} to {self.mean + self.half:+.1f})"
        )


def compared(cases: list[Case], label: str, other: str = PI) -> Comparison:
    """Compare two methods by the cursor in all pairs of person and plant that both can fit."""
    both = [one for one in cases if not (one.named(label).reason or one.named(other).reason)]
    counts, persons = [0, 0, 0], dict[str, list[float]]()
    for case in both:
        mean, half = interval(apart(case, label, other))
        counts[2 if abs(mean) <= half else int(mean < 0)] += 1
        persons.setdefault(case.person, []).append(mean)
    means = np.array([np.mean(one) for one in persons.values()])
    median = float(np.median([one for own in persons.values() for one in own]))
    better, worse, neither = counts
    mean, half = interval(means)
    return Comparison(better, worse, neither, median, mean, half, len(persons))


def summary(cases: list[Case]) -> str:
    """First paragraphs: whether the offset-free controller predicts better, and what is missing."""
    free, refitted = compared(cases, OFFSET_FREE), compared(cases, REFITTED)
    word = "as well as delayed PI (PID), not better"
    if abs(free.mean) > free.half:
        word = f"{'better' if free.mean > 0 else 'worse'} than delayed PI (PID)"
    missing = sum(
        one.ceiling is not None
        and max(fit.mean() for fit in one.fits if not fit.reason) < one.ceiling[1, 0]
        for one in cases
    )
    lqr = sum(bool(one.named("inverse LQR").reason) for one in cases)
    found = [one.mean() for one in (case.named("output") for case in cases) if not one.reason]
    text = (
        f"Offset-free inverse MPC predicts held-out trials {word}: it is {free}. By chance alone "
        f"{0.05 * len(cases):.1f} of {len(cases)} pairs would differ clearly. Plain inverse MPC "
        f"against delayed PI is {compared(cases, 'inverse MPC')}.\n\n"
        f"Delayed PI fitted to the held-out trials themselves is {refitted} against delayed PI "
        "fitted to the others. This part of the error is change of the person: no fit to other "
        f"trials predicts it. In {missing} of {len(cases)} pairs part of the movement that repeats "
        f"is unexplained by every method. Inverse LQR has no result in {lqr} of {len(cases)} "
        f"pairs. The search of output feedback converged in {len(found)} of {len(cases)}"
    )
    shares = ", ".join(f"{one:.0f}" for one in sorted(found))
    return text + (f" (VAF {shares} %)." if found else ".")


def predictions(cases: list[Case]) -> str:
    """Tables of the VAF of every method, by pair of person and plant."""
    labels = [label for label, *_ in METHODS]
    names = ["delayed", "the same, fitted to these trials", *labels[2:]]
    heads = ["pair", "ceiling (95 %)", *names, "offset-free - delayed (95 %)"]
    rows, others = [], []
    for case in cases:
        top, new = case.ceiling, np.array(case.unseen)
        cells = [
            "-" if case.named(one).reason else f"{case.named(one).mean():.1f}" for one in labels
        ]
        low = "-" if top is None else f"{top[0, 0]:.1f} ({top[1, 0]:.1f} to {top[2, 0]:.1f})"
        mean, half = interval(apart(case, OFFSET_FREE))
        rows.append([case.title, low, *cells, f"{mean:+.1f} ± {half:.1f}"])
        shown = [case.named(one) for one in (PI, "inverse MPC", OFFSET_FREE)]
        others.append([
            case.title,
            *(f"{np.mean(one.train[:, 0]):.1f}" for one in shown),
            *(f"{np.mean(one.test[new, 0]):.1f}" if np.any(new) else "-" for one in shown),
            "-" if top is None else f"{top[0, 1]:.1f}",
            *(f"{one.mean(1):.1f}" for one in shown),
        ])  # fmt: skip
    three = ["delayed", "inverse MPC", "offset-free"]
    heads_2 = ["pair", *(f"fitted, {one}" for one in three), *(f"new, {one}" for one in three)]
    heads_2 += ["slider, ceiling", *(f"slider, {one}" for one in three)]
    return (
        f"VAF of the cursor, held out, %:\n\n{table(heads, rows)}\n\nVAF on the fitted trials, on "
        "new waveforms (cursor), and of the slider (held out), %:\n\n" + table(heads_2, others)
    )


def identified(cases: list[Case]) -> str:
    """Fitted values by pair, and the doubts and warnings of all fits."""
    names = ["delay", "lag", "learning"]
    rows = []
    for case in cases:
        delayed, free = case.named(PI).values, case.named(OFFSET_FREE)
        entries = [text for name, text in free.values.items() if name.startswith("K.")]
        known = sum(text != "not identified" for text in entries)
        plain = ", ".join(f"{name} {value}" for name, value in delayed.items())
        cells = [free.values.get(name, "not available") for name in names]
        rows.append([case.title, plain, *cells, f"{known} of {len(entries)}"])
    notes = Counter(note for case in cases for one in case.fits for note in one.notes)
    kinds = Counter(_kind(note) for note in notes.elements())
    kinds.update(f"Python warning: {text}" for case in cases for text in case.warned)
    heads = ["pair", "delayed PI, PID (delay in s)", "delay, s", "lag, s", "learning, 1/s", "gains"]
    listed = "\n".join(f"- {text} ({count} fits)" for text, count in kinds.most_common())
    return f"{table(heads, rows)}\n\nDoubts and warnings of all fits:\n\n{listed}"


def _kind(note: str) -> str:
    """A doubt without its numbers."""
    return " ".join("X" if part.strip("(,.:%)").replace(".", "").isdigit() else part
                    for part in note.split())  # fmt: skip


def _spectra(signals: list[Array]) -> Array:
    """Fourier coefficients of the last two periods of each trial (pieces, frequencies)."""
    pieces = [part for one in signals for part in np.split(one[-2 * PERIOD :], 2)]
    return np.asarray(np.fft.rfft(np.array(pieces), axis=1) * 2 / PERIOD)


def responses(cases: list[Case]) -> str:
    """Response of the slider to the disturbance at the sines, by plant: recorded and modelled."""
    parts = []
    for kind in sorted({case.kind for case in cases}):
        found: dict[int, list[list[float]]] = {}
        for case in (one for one in cases if one.kind == kind):
            push = _spectra([one[:, 3] for one in case.test])
            power = np.sum(np.abs(push) ** 2, axis=0)
            hands = [[one[:, 2] for one in case.test]]
            hands += [[run[:, 1] for run in case.named(one).simulated] for one in (OFFSET_FREE, PI)]
            own = [_spectra(one) for one in hands]
            # Against the disturbance, so that 1 and 0 degrees are ideal
            across = [-np.sum(np.conj(push) * one, axis=0) for one in own]
            for k in np.flatnonzero(power[1:] > _DRIVEN**2 * power[1:].max()) + 1:
                first, *models = (complex(one[k] / power[k]) for one in across)
                whole = power[k] * np.sum(np.abs(own[0][:, k]) ** 2)
                row = [abs(first), float(np.angle(first)), float(abs(across[0][k]) ** 2 / whole)]
                for one in models:
                    row += [abs(one / first), float(np.angle(one / first))]
                found.setdefault(int(k), []).append(row)
        rows = []
        for index, values in sorted(found.items()):
            mean = np.mean(values, axis=0)
            turns = np.degrees(np.angle(np.mean(np.exp(1j * np.array(values)), axis=0)))
            cells = [f"{turns[j]:.0f}" if j in (1, 4, 6) else f"{mean[j]:.2f}" for j in range(7)]
            rows.append([f"{index * RATE / PERIOD:.2f}", str(len(values)), *cells])
        heads = ["Hz", "persons", "recorded, gain", "phase", "coherence"]
        heads += [
            f"{one}, {what}" for one in ("offset-free", "delayed") for what in ("gain", "phase")
        ]
        parts.append(f"{PLANTS[kind]} ({kind}):\n\n{table(heads, rows)}")
    return "\n\n".join(parts)


def figure(cases: list[Case]) -> Figure:
    """Held-out VAF of each method per person and plant, with the ceiling."""
    drawing = new_figure(9.5, 4.2)
    axes = drawing.add_subplot()
    for k, case in enumerate(cases):
        if case.ceiling is not None:
            top, label = case.ceiling[0, 0], "ceiling" if k == 0 else None
            axes.plot([k - 0.42, k + 0.42], [top, top], color=INK, linewidth=1.5, label=label)
        for j, (name, marker, colour) in enumerate(METHODS):
            one, place = (
                case.fits[[fit.label for fit in case.fits].index(name)],
                k + 0.14 * (j - 2.5),
            )
            shown = np.clip(one.test[:, 0], 0, 100)
            axes.plot(place + 0 * shown, shown, ".", color=colour, markersize=3, alpha=0.5)
            mean, label = [max(one.mean(), 0.0)], name if k == 0 else None
            axes.plot([place], mean, marker, color=colour, linestyle="none", label=label)
    axes.set_xticks(range(len(cases)), [case.title for case in cases], rotation=45, ha="right")
    axes.set_ylabel("held-out VAF of the cursor (%)")
    axes.set_ylim(-3, 100)
    drawing.legend(ncols=4, loc="outside upper center", fontsize=8)
    return drawing


def write_page(cases: list[Case], digest: str, skipped: list[str], seconds: float) -> None:
    """Write the page and its figure next to this file."""
    here = Path(__file__).parent
    (here / "images" / "steering.svg").write_bytes(drawn(lambda: figure(cases), "svg"))
    known = "Their digest is that of the published files." if digest == DIGEST else (
        "Their digest is not that of all published files: this page is of another selection."
    )  # fmt: skip
    if skipped:
        known += f" Left out: {'; '.join(skipped)}."
    data = _DATA.format(
        plants=" and ".join(f"{text} ({kind})" for kind, text in PLANTS.items()),
        persons=len({case.person for case in cases}),
        count=len(cases),
        known=known,
        seconds=seconds,
    )
    text = joined(
        "# People who steer a cursor against a disturbance",
        summary(cases),
        "![Held-out VAF by person, plant and method](images/steering.svg)",
        "Held-out VAF of the cursor (dots: trials; markers: means; line: ceiling); values below 0 "
        "are drawn at 0.",
        data,
        table(["method", "how it is fitted"], _HOW.items()),
        _SCORE,
        predictions(cases),
        _IDENTIFIED,
        identified(cases),
        _RESPONSE,
        responses(cases),
    )
    (here / "steering.md").write_text(text, encoding="utf-8")
