"""Verdict of the fit of one subject, visit and condition."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impc.assess.lack_of_fit import LIMIT
from impc.reporting.finding import Level
from impc.reporting.rendering import number
from impc.reporting.shown_units import signal_name
from impc.reporting.verdict import Verdict
from impc.studies.fit.facts import limits
from impc.studies.fit.result import LITTLE

if TYPE_CHECKING:
    from impc.assess.assessments import MethodFit
    from impc.assess.lack_of_fit import LackOfFit
    from impc.assess.weights_test import WeightsTest


def unit_verdict(
    fit: MethodFit, lack: LackOfFit | None, test: WeightsTest, saturated: float, identified: bool
) -> Verdict:
    """Verdict of a fit: the first case that applies, worst first."""
    fallen = sum(one is not None for one in fit.fell)
    culprit = None if lack is None else lack.culprit
    plant = fit.estimate.problem.plant
    limit = " and ".join(limits(plant, np.array(fit.bounds.u_min), np.array(fit.bounds.u_max)))
    shares = zip(plant.outputs, fit.vaf, strict=True)
    explained = " and ".join(f"{number(one, 4)} % of {signal_name(plant, name)}"
                             for name, one in shares)  # fmt: skip
    predicted = f"It explains {explained} (VAF)."
    within = f"a limit of {limit}" if limit else "no limit of the command"
    reached = " The limit is never reached." if limit and not saturated else ""
    unknown = "" if identified else " No entry of the gain is individually identified."
    cases: tuple[tuple[bool, Level, str, str], ...] = (
        (fallen == len(fit.fell), Level.RED, "The simulation stops early in every trial.",
         "Do not use the numbers of this fit."),
        (not fallen and not np.all(fit.vaf >= LITTLE), Level.RED,
         "The model explains less than half of a recorded signal.", predicted),
        (fallen > 0, Level.AMBER,
         f"The simulation stops early in {fallen} of {len(fit.fell)} trials.",
         "The gains describe at most the other trials."),
        (not fit.estimate.converged, Level.AMBER, "The search stopped before it converged.",
         predicted),
        (culprit is not None and culprit.name == LIMIT, Level.AMBER,
         f"The model follows the movement, but {within} is probably wrong.",
         "Gains may be several times too small. Fit this person with unknown_limit = true."),
        (culprit is not None, Level.AMBER,
         "The model follows the movement, but the body model seems to be inexact.",
         "Part of the residual follows the perturbation: gains may be biased."),
        (test.rejected, Level.AMBER, "No cost weights explain the fitted gain.",
         "Report its gains, but no cost weights."),
        (True, Level.GREEN, f"A controller with {within} explains this movement.",
         f"{predicted}{reached}{unknown}"),
    )  # fmt: skip
    return Verdict(*next(case for case in cases if case[0])[1:])
