"""Two-link standing on a moving platform (Park, Horak and Kuo 2004): simulation and comparison.

Parameters, gain and platform are those of the example of Moore and van den Bogert's direct
collocation. The simulated body is nonlinear with continuous feedback; the fitted plant is linear
and sampled. The command writes experiments/two_link_standing.md and its figure.

    python -m experiments.two_link_standing
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import impc
from experiments.two_link_peers import (
    DURATION,
    GAIN,
    Fits,
    collocation,
    fits_of,
    gravity_stiffness,
    least_factor,
    shooting,
    standing,
    standing_problem,
    standing_recording,
)
from impc.model.continuous_gain import held_gain
from impc.reporting.style import BLUE, drawn, new_figure

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.figure import Figure

    from impc.arrays import Array

__all__ = ["GAIN", "standing", "standing_problem", "standing_recording"]


_METHODS = {
    "feedback_gain": "impc `feedback_gain`",
    "equal": "impc `feedback_gain`, equal scales",
    "inverse_mpc": "impc `inverse_mpc`",
    "collocation": "direct collocation (peer A)",
    "shooting": "shooting, nonlinear body (peer B)",
    "linear": "shooting, linear body",
    "one step": "one-step regression",
}
_GAINS = [f"{joint} / {state}" for joint in ("ankle", "hip") for state in ("a", "h", "a'", "h'")]
_FOLDER = Path(__file__).parent


def _table(fits: list[Fits]) -> str:
    """Markdown table: median and largest absolute relative error of each gain, and run time."""
    lines = ["| method | " + " | ".join(_GAINS) + " | s |", "|" + "---|" * 10]
    for name, title in _METHODS.items():
        errors = np.abs([one.error(name) for one in fits])
        cells = [
            f"{m:.1f}, {w:.1f}" for m, w in zip(np.median(errors, 0), errors.max(0), strict=True)
        ]
        took = np.median([one.seconds[name] for one in fits])
        lines.append(f"| {title} | " + " | ".join(cells) + f" | {took:.2g} |")
    return "\n".join(lines)


def _doubts(said: Iterable[Iterable[str]]) -> str:
    """List of the doubts, with the misfit replaced by a letter, and how often each was given."""
    plain = [re.sub(r"misfit, [0-9.e+-]+", "misfit, X", doubt) for some in said for doubt in some]
    return "\n".join(f"- {doubt} ({count} times)" for doubt, count in Counter(plain).items())


def _wrapped(text: str) -> str:
    """Text with its plain paragraphs filled to 100 columns."""
    parts = text.split("\n\n")
    filled = [one if one[:1] in "#|-!" else textwrap.fill(one, 100) for one in parts]
    return "\n\n".join(filled).rstrip() + "\n"


def _worst(fits: list[Fits], method: str) -> float:
    """Median over recordings of the largest relative error of a gain, %."""
    return float(np.median([np.max(np.abs(one.error(method))) for one in fits]))


def _figure(groups: dict[str, list[Fits]]) -> Figure:
    """Relative error of every gain of every recording, by method."""
    figure = new_figure(9.0, 3.6)
    panels = figure.subplots(1, 2, sharey=True, sharex=True)
    for ax, (title, fits) in zip(panels, groups.items(), strict=True):
        for row, name in enumerate(_METHODS):
            errors = np.abs([one.error(name) for one in fits]).ravel()
            heights = row + np.linspace(-0.25, 0.25, errors.size)
            ax.plot(errors, heights, "o", color=BLUE, markersize=3)
        ax.set(title=title, xscale="log", xlabel="relative error of a gain (%)")
        ax.set_yticks(range(len(_METHODS)), [name.replace("`", "") for name in _METHODS.values()])
    panels[0].invert_yaxis()
    return figure


def _explained(groups: dict[str, list[Fits]]) -> str:
    """Section on weights: whether any have the true gain, and what the nearest ones do."""
    first = groups["clean"][0]
    plant = first.free.problem.plant
    true = impc.inverse_lqr_lmi(plant, held_gain(plant, GAIN))
    every = [one for fits in groups.values() for one in fits]
    none = sum(not impc.inverse_lqr_lmi(plant, one.free.gain).feasible for one in every)
    factor, stiffness = least_factor(), gravity_stiffness()
    ankle = np.median([one.gains["inverse_mpc"][0, 0] for one in every])
    ratio = np.median([one.optimal.misfit / one.free.misfit for one in every])
    vaf = np.median([[one.optimal.vaf, one.free.vaf] for one in every], axis=0)
    statuses = {
        name: sorted({e.status.value for e in found})
        for name, found in (
            ("feedback_gain", [one.free for one in every]),
            ("inverse_mpc", [one.optimal for one in every]),
        )
    }
    says = "has" if true.feasible else "has no"
    return f"""## What optimal control cannot explain

The true gain, sampled, {says} quadratic weights: `impc.inverse_lqr_lmi` ends with "{true.status}".
The free gains of {none} of {len(every)} recordings have no weights either. The
stability margin explains this. An optimal state feedback of the continuous plant stays stable if
all its gains are multiplied by any factor above 0.5, whatever the weights. The true gain
becomes unstable at factor {factor:.3f}: its ankle stiffness is {GAIN[0, 0]:.0f} N m/rad,
{GAIN[0, 0] / stiffness:.2f} times that of gravity ({stiffness:.0f} N m/rad).

`inverse_mpc` must therefore choose another gain. Its median ankle stiffness is {ankle:.0f} N m/rad,
{ankle / stiffness:.2f} times that of gravity. Its misfit is {ratio:.1f} times that of the free gain
(median). The median VAF of the four states is {", ".join(f"{v:.1f}" for v in vaf[0])} %, against
{", ".join(f"{v:.1f}" for v in vaf[1])} % for the free gain. The errors of `inverse_mpc` in the
tables are the cost of requiring optimality. They are not noise.

`.status` is {", ".join(statuses["feedback_gain"])} for `feedback_gain` (a gain without weights) and
{", ".join(statuses["inverse_mpc"])} for `inverse_mpc`. A status "settled" means that the search
ended. It does not mean that optimal control is adequate; `.doubts` says that it is not:

{_doubts([one.optimal.doubts for one in every])}
"""


def _biases(groups: dict[str, list[Fits]]) -> str:
    """Section on biases: median signed error of the gain with the largest error, step by step."""
    steps = {
        "shooting": "nonlinear body, continuous feedback, equal scales",
        "linear": "linear body, continuous feedback, equal scales",
        "equal": "linear body, held feedback, equal scales",
        "feedback_gain": "linear body, held feedback, scales by signal",
    }
    rows = [
        "| assumption of the fit | "
        + " | ".join(f"{g}, {_GAINS[4]}, % | {g}, largest of 8, %" for g in groups)
        + " |",
        "|" + "---|" * (1 + 2 * len(groups)),
    ]
    for name, title in steps.items():
        cells = [
            f"{np.median([one.error(name)[4] for one in fits]):+.1f} | {_worst(fits, name):.1f}"
            for fits in groups.values()
        ]
        rows.append(f"| {title} | " + " | ".join(cells) + " |")
    measured = groups["clean"][0].free.problem.recordings[0].outputs
    angles = np.degrees(np.abs(measured[:, :2]).max(axis=0))
    every = [one for fits in groups.values() for one in fits]
    return f"""## Biases and assumptions

Each row changes one assumption; the {_GAINS[4]} column is the median signed error of that gain.

{chr(10).join(rows)}

- Linear body: the angles reach {angles[0]:.0f} degrees (ankle) and {angles[1]:.0f} degrees (hip) in
  the first clean recording. Row 2 minus row 1 is the effect of linearisation.
- Held feedback: the simulated torque is continuous, impc holds it for a sample. The gains of
  impc and of the regression are converted to continuous time (`impc.model.continuous_gain`). The
  conversion neglects second-order terms of the sample time, and it omits how the
  platform moves the state within a sample. Row 3 minus row 2
  contains this effect.
- Scales: all states have measurement noise of the same standard deviation, so equal scales are
  efficient if the model is correct. With a linear body they also weight its errors in the
  fast rates more. impc divides each state by its root mean square by default. Row 4 minus row 3 is
  this effect.
- Noise in the loop: all fits but the regression treat the loop as deterministic between the
  platform and the states. The sensory noise of the noisy recordings enters as process noise and is
  not modelled. Row 1 has no other model error: its noisy columns show scatter and bias together.
  With {len(groups["noisy"])} recordings the two cannot be separated.
- Measured inputs: the platform acceleration is measured with noise and taken as exact by all fits.
- One-step regression has noise in its regressors, which biases it on clean recordings too.

impc gave these doubts; the causes are those of this page (unmodelled process noise, linear body,
held torque, weights that do not exist, and the failed search with equal scales):

{_doubts([one.doubts for one in every])}

The semidefinite solver can print "Eigval error" to the terminal in a search for weights. impc
catches this failure.
"""


def _page(groups: dict[str, list[Fits]], zero: Array, euler: Array) -> str:
    """Text of the page, verdict first."""
    clean, noisy = groups.values()
    worst = {n: (_worst(clean, n), _worst(noisy, n)) for n in _METHODS}
    free, direct, shot = worst["feedback_gain"], worst["collocation"], worst["shooting"]
    behind = ["behind" if a > b else "ahead of" for a, b in zip(free, direct, strict=True)]
    most = {n: max(np.max(np.abs(one.error(n))) for one in noisy) for n in _METHODS}
    lost = sum(np.max(np.abs(one.error("equal"))) > 100 for one in clean + noisy)
    far = max(np.max(np.abs(one.error("equal"))) for one in clean + noisy)
    weak = np.median([abs(one.gains["feedback_gain"] - GAIN)[1, 0] for one in clean])
    cost = {n: np.median([one.seconds[n] for one in clean + noisy]) for n in _METHODS}
    simple = worst["one step"]
    return f"""# Two-link standing: eight gains of Park, Horak and Kuo (2004)

impc `feedback_gain` is {behind[0]} direct collocation on clean recordings (error
{free[0]:.1f} against {direct[0]:.1f} %) and {behind[1]} it on noisy ones
({free[1]:.1f} against {direct[1]:.1f} %). The
error is the largest of eight gains, median of {len(clean)} recordings. Over the noisy recordings
the largest error is {most["feedback_gain"]:.0f} % for impc and {most["collocation"]:.0f} % for
collocation, so {len(noisy)} noisy recordings do not separate the two. Plain shooting has
{shot[0]:.1f} and {shot[1]:.1f} %, in {cost["shooting"]:.1f} s against {cost["feedback_gain"]:.1f} s
for impc. The peers fit the nonlinear body with continuous feedback, which is the simulated model.
impc fits a linear body with held feedback. The largest clean error is in {_GAINS[4]}, the weakest
gain: {weak:.1f} of {GAIN[1, 0]:.0f} N m/rad. The simple one-step regression is worse:
{simple[0]:.1f} and {simple[1]:.1f} %. impc `inverse_mpc` has {worst["inverse_mpc"][0]:.0f} and
{worst["inverse_mpc"][1]:.0f} %, because no quadratic weights have this gain.

![Relative error of each gain by method](images/two_link_standing.svg)

Each dot is the error of one of the eight gains in one recording.

## Methods and errors

Each entry is the median and the largest absolute relative error over {len(clean)} recordings, in %.
Columns: torque / state (a, h: ankle and hip angle; a', h': rates). Last column: median run time.
All methods use the same recordings of {DURATION:.0f} s with 4000 samples.

Clean (measurement noise only):

{_table(clean)}

Noisy (sensory noise in the loop as well):

{_table(noisy)}

With equal scales the search of `feedback_gain` ends far from the true gain (above 100 %) in
{lost} of {len(clean + noisy)} recordings; its largest error is {far:.0f} %. The doubts of all fits
are listed below. With its default scales impc has no such failure here.

Peer A is the formulation of opty: midpoint rule, states of all samples and gains as unknowns, IPOPT
with exact derivatives. opty itself could not be installed here;
the problem is written in CasADi. It starts at the measured states and at zero gains. With
backward Euler instead of the midpoint rule, its largest error on the first clean recording is
{np.max(np.abs(100 * (euler / GAIN - 1))):.1f} %. Peer B is `scipy.optimize.least_squares` with
finite differences over a Runge-Kutta simulation. It starts at the LQR gain of unit weights. From
zero gains, which do not stabilise the body, its largest error on that recording is
{np.max(np.abs(100 * (zero / GAIN - 1))):.0f} %. Direct collocation takes
{cost["collocation"]:.1f} s, shooting {cost["shooting"]:.1f} s, `feedback_gain`
{cost["feedback_gain"]:.1f} s and `inverse_mpc` {cost["inverse_mpc"]:.1f} s (medians).

"""


def main() -> None:
    """Fit all recordings and write the page and its figure."""
    seeds = (1, 2, 3)
    groups = {
        name: [fits_of(seed, noisy) for seed in seeds]
        for name, noisy in (("clean", False), ("noisy", True))
    }
    first, nothing = standing_recording(seeds[0], noisy=False), np.zeros((2, 4))
    zero = shooting(first, nothing)
    euler = collocation(first, nothing, midpoint=False)
    (_FOLDER / "images/two_link_standing.svg").write_bytes(drawn(lambda: _figure(groups), "svg"))
    text = _page(groups, zero, euler) + _explained(groups) + "\n" + _biases(groups)
    (_FOLDER / "two_link_standing.md").write_text(_wrapped(text), encoding="utf-8")


if __name__ == "__main__":
    main()
