"""Page and figure of `experiments.steering`: who predicts best, and what is identified."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.stats

from experiments.steering_figure import figure, response
from impc.arrays import Array

HERE = Path(__file__).parent
PLANTS = {"fo": "y' = u + d", "so": "y'' = u + d - y'"}
#: Text for methods with any outcome: how each is fitted.
_METHODS = """\
| method | how it is fitted |
|---|---|
| delayed PI (fo), PID (so) | gains on y, its integral and, for so, its rate, with one delay in \
whole samples, by least squares on y (shooting) |
| inverse LQR | `impc.fit(problem, "inverse_lqr")`: cost weights whose gain is that of the best \
unbounded controller, or near it; delay and lag of inverse MPC |
| inverse MPC | cost weights that fit cursor and slider; delay (Padé, order 2) and lag are free |
| offset-free inverse MPC | the same with `impc.with_observer`: the disturbance is learnt at a \
free rate |
| output feedback | `impc.fit_output_feedback`: y is sensed with noise and the disturbance is \
estimated as a random walk; delay and lag of the offset-free fit are fixed |
"""
_DATA = """\
Yamagami, Howell, Roth and Burden (CPHS 2018) published the recordings in the repository \
EmDash00/CPHS2017 (commit f6537a0, experiment/data). They have no licence and are not part of the \
project. Subjects hold a cursor y at zero with a slider u against a disturbance d, a sum of sines. \
Trials last 45 s at 60 Hz and contain two periods of 20 s. Plant and disturbance are exact.

`python -m experiments.steering FOLDER {most}` wrote this page in {seconds:.0f} s. Each method was \
fitted to the first {most} trials with phases p, output feedback to the first one. \
The disturbance of a trial m is that of its trial p with the opposite sign. *New waveform* \
therefore counts only the trials m whose disturbance mirrors no fitted one.
"""
_SCORE = """
VAF is that of a simulation driven by the disturbance alone, in % over the last 40 s, mean of \
trials. The simulation starts at the recorded cursor with the hand at rest. The ceiling \
(`impc.assess.ceiling`) is the part that repeats between the two periods, with a 95 % interval. No \
bound is set, so inverse MPC differs from LQR only in what is fitted. Classical inverse LQR \
approximates a gain and not the movement. Where the gain is not identified, a near gain can move \
differently or have no cost weights. Output feedback is fitted to one trial, \
because of its run time. A VAF far below 0 means that this fit failed, and not that the model is \
rejected.
"""
_IDENTIFIED = """\
Values with 95 % intervals. *Not identified* means that the interval is wider than a factor of 10 \
or contains zero. Different combinations of gain, delay and lag move alike, so that single numbers \
of a fit are no properties of a subject unless their interval is given. Noise SDs of output \
feedback have no intervals here; a sensory SD near zero means that the fit found no sensory noise.
"""
_RESPONSE = """\
Response of the slider to the disturbance at the frequencies of the sines, over the held-out \
trials. The sign of the slider is inverted: gain 1 and phase 0 degrees cancel the disturbance. \
Coherence is that of the recording: its complement is noise or nonlinearity.
"""
#: Explanation of each warning and doubt, by a part of its text.
_EXPLAINED = {
    "autocorrelated": "A subject's noise acts inside the loop, and the plant integrates it. White "
    "residuals are not expected, and the intervals use a covariance for autocorrelated residuals.",
    "of the recordings (2-norm)": "The ceiling shows how much of this residual is noise.",
    "Only one of several": "The objective has several minima, because delay, lag and gain can "
    "replace one another.",
    "directions of the gain": "The remaining directions of the gain have no effect on these "
    "recordings.",
    "Another gain has": "The gain that fits best belongs to no cost weights.",
    "converged": "The likelihood search of output feedback converged.",
    "smaller misfit here": "The search ended in a local minimum.",
}


@dataclass(frozen=True)
class Fit:
    """One method on one person and plant; VAF in % of cursor and slider (trials, 2)."""

    label: str
    train: Array
    test: Array
    simulated: list[Array] = field(default_factory=list)  # Of each test trial (samples, 2)
    reason: str = ""  # Why there is no controller
    notes: tuple[str, ...] = ()  # Doubts in words
    parameters: tuple[str, ...] = ()  # Fitted values with intervals
    seconds: float = 0.0

    @property
    def mean(self) -> float:
        """Mean held-out VAF of the cursor, %; minus infinity without a controller."""
        return -np.inf if self.reason else float(np.mean(self.test[:, 0]))


@dataclass(frozen=True)
class Case:
    """Recordings and fits of one person with one plant."""

    person: str
    kind: str
    train: list[Array]
    test: list[Array]
    unseen: list[bool]  # Whether a test disturbance mirrors no fitted one
    ceiling: Array | None  # Rows VAF, low and high; columns cursor and slider
    fits: list[Fit]
    warned: tuple[str, ...]  # Python warnings of the fits

    @property
    def title(self) -> str:
        """Person and plant."""
        return f"{self.person} {self.kind}"

    def named(self, label: str) -> Fit:
        """Fit of the method whose label begins so."""
        return next(one for one in self.fits if one.label.startswith(label))


def paired(one: Fit, other: Fit) -> tuple[float, float]:
    """Mean difference of the held-out VAF and half its 95 % interval over trials, points."""
    apart = one.test[:, 0] - other.test[:, 0]
    if len(apart) < 2:
        return float(apart.mean()), np.inf
    error = np.std(apart, ddof=1) / np.sqrt(len(apart))
    return float(apart.mean()), float(scipy.stats.t.ppf(0.975, len(apart) - 1) * error)


def outcome(case: Case) -> int:
    """1 if offset-free inverse MPC predicts better than delayed feedback, -1 if worse, else 0."""
    free = case.named("offset-free")
    if free.reason:
        return -1
    apart, half = paired(free, case.named("delayed"))
    return 0 if abs(apart) <= half else int(np.sign(apart))


def why_behind(case: Case) -> str:
    """Reason for a deficit of offset-free inverse MPC, as far as the numbers show one."""
    free, delayed = case.named("offset-free"), case.named("delayed")
    if free.reason:
        return f"It found no controller: {free.reason}."
    here, there = (float(np.mean(one.train[:, 0])) for one in (free, delayed))
    hand, hand_delayed = (float(np.mean(one.test[:, 1])) for one in (free, delayed))
    text = f"On the fitted trials the two reach {here:.1f} and {there:.1f} %"
    if here >= there:
        return f"{text}: the deficit is in the trials that were not fitted."
    if hand > hand_delayed:
        return (
            f"{text}. Inverse MPC fits cursor and slider together and gains on the slider: "
            f"{hand:.1f} against {hand_delayed:.1f} % held out."
        )
    return f"{text}, so overfitting is not the reason: this cost and hand do not describe the loop."


def verdict(case: Case) -> str:
    """Sentences on one person and plant."""
    best = max(case.fits, key=lambda one: one.mean)
    text = f"- **{case.title}:** {best.label} has the highest VAF ({best.mean:.1f} %)."
    free, delayed = case.named("offset-free"), case.named("delayed")
    if not free.reason:
        apart, half = paired(free, delayed)
        text += (
            f" Offset-free inverse MPC minus delayed feedback is {apart:+.1f} points "
            f"(95 % interval ± {half:.1f}, {len(free.test)} trials)"
        )
        text += {1: ": better.", 0: ": no clear difference.", -1: ": worse."}[outcome(case)]
    if outcome(case) < 0:
        text += f" {why_behind(case)}"
    if case.ceiling is not None:
        top, low, _ = case.ceiling[:, 0]
        gap = f" The ceiling is {top:.1f} %, and {top - best.mean:.1f} points of it"
        if best.mean < low:
            text += f"{gap} are unexplained by every method."
        elif best.mean < top:
            text += f"{gap} are missing, which is within its 95 % interval."
        else:
            text += f" The ceiling of {top:.1f} % is reached."
    return text


def summary(cases: list[Case]) -> str:
    """First paragraph: in how many cases each method predicts best."""
    ends = [outcome(case) for case in cases]
    winners = [max(case.fits, key=lambda one: one.mean).label for case in cases]
    counted = ", ".join(f"{name} in {winners.count(name)}" for name in sorted(set(winners)))
    missing = sum(
        case.ceiling is not None and max(one.mean for one in case.fits) < case.ceiling[1, 0]
        for case in cases
    )
    return (
        f"Highest mean VAF of the cursor on held-out trials, over {len(cases)} pairs of person and "
        f"plant: {counted}. Against delayed feedback, offset-free inverse MPC is better in "
        f"{ends.count(1)}, worse in {ends.count(-1)}, and not clearly different in "
        f"{ends.count(0)}. In {missing} of {len(cases)}, part of the movement that repeats is "
        "unexplained by every method."
    )


def table(case: Case) -> str:
    """VAF of every method for one person and plant."""
    new = np.array(case.unseen)
    rows = [
        "| method | cursor, fitted trials | cursor, held out | of these, new waveform | slider, "
        "held out | fit, s |",
        "|---|---|---|---|---|---|",
    ]
    if case.ceiling is not None:
        top, low, high = case.ceiling
        rows.append(
            f"| ceiling | | {top[0]:.1f} ({low[0]:.1f} to {high[0]:.1f}) | | "
            f"{top[1]:.1f} ({low[1]:.1f} to {high[1]:.1f}) | |"
        )
    for one in case.fits:
        if one.reason:
            rows.append(f"| {one.label} | none | none | none | none | {one.seconds:.0f} |")
            continue
        own = f"{np.mean(one.test[new, 0]):.1f}" if np.any(new) else "-"
        rows.append(
            f"| {one.label} | {np.mean(one.train[:, 0]):.1f} | {one.mean:.1f} | {own} | "
            f"{np.mean(one.test[:, 1]):.1f} | {one.seconds:.0f} |"
        )
    missing = [f"{one.label} has no result: {one.reason}." for one in case.fits if one.reason]
    return "\n".join([f"### {case.title}: {PLANTS[case.kind]}", "", *rows, "", *missing])


def identified(case: Case) -> str:
    """Fitted values and doubts of one person and plant."""
    lines = [f"**{case.title}**", ""]
    for one in case.fits:
        said = "; ".join(one.parameters)
        if said:
            lines.append(f"- {one.label}: {said}. {' '.join(one.notes)}".rstrip())
    return "\n".join(lines)


def doubts(cases: list[Case]) -> str:
    """Every warning and doubt of the run, where it occurred and what it means."""
    where: dict[str, list[str]] = {}
    for case in cases:
        for one in case.fits:
            for note in one.notes:
                key = next((part for part in _EXPLAINED if part in note), note)
                where.setdefault(key, []).append(f"{case.title} ({one.label})")
        for text in case.warned:
            where.setdefault(f"Python warning: {text}", []).append(case.title)
    lines = []
    for key, places in where.items():
        fits = "1 fit" if len(places) == 1 else f"{len(places)} fits"
        lines.append(f"- *{key}*, in {fits}. {_EXPLAINED.get(key, '')}".rstrip())
    if not any(case.warned for case in cases):
        lines.append("- No Python warning was raised.")
    return "\n".join(lines)


def write_page(
    cases: list[Case], sources: list[str], skipped: list[str], most: int, seconds: float
) -> None:
    """Write the page and its figure next to this file."""
    images = HERE / "images"
    images.mkdir(exist_ok=True)
    (images / "steering.svg").write_bytes(figure(cases))
    absent = f"Left out: {'; '.join(skipped)}.\n" if skipped else ""
    parts = [
        "# People who steer a cursor against a disturbance",
        summary(cases),
        "\n".join(verdict(case) for case in cases),
        "![Held-out VAF by person, plant and method](images/steering.svg)",
        "Held-out VAF of the cursor (dots: trials; markers: means; line: ceiling); values below 0 "
        "are drawn at 0.",
        "## Data",
        _DATA.format(most=most, seconds=seconds) + absent,
        "Files of this run: " + ", ".join(sources) + ".",
        "## Prediction",
        _METHODS + _SCORE,
        "\n\n".join(table(case) for case in cases),
        "## What is identified",
        _IDENTIFIED,
        "\n\n".join(identified(case) for case in cases),
        "### Warnings of the fits",
        doubts(cases),
        "## Frequency response",
        _RESPONSE,
        "\n\n".join(response(case) for case in cases),
    ]
    text = "\n\n".join(part.strip() for part in parts)
    (HERE / "steering.md").write_text(text + "\n", encoding="utf-8")
