"""Report of a single estimate from Python (`impc.report`)."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from impc.assess.assessments import MethodFit, evaluate_method
from impc.checking import checked, replace
from impc.errors import InputError
from impc.inverse.estimates import Estimate
from impc.levels import Level
from impc.reporting.document import Report, Section
from impc.reporting.finding import Picture
from impc.reporting.provenance import Provenance
from impc.reporting.writer import owned, write_files
from impc.studies.compare.report import compare_report
from impc.studies.fit.figures import movement_figure
from impc.studies.fit.first import FitProgress
from impc.studies.fit.report import fit_report
from impc.studies.fit.settings import FitSettings
from impc.studies.fit.subject import fit_recordings
from impc.studies.methods_table import controller_findings, method_label

_OURS = "inverse_mpc"
_CALLER = "given by the program that called impc.report"


class OwnPage(Protocol):
    """An estimate that makes its own report, such as that of an optimal control problem."""

    def page(self, provenance: Provenance) -> Report:
        """The report with its tables and figures."""


_PICTURE = Picture(
    "trial-1",
    "Outputs and commands of the first trial: recorded and simulated",
    "Trial 1. Grey: recorded; blue: simulated; orange: at the limit.",
)


@checked
def report(
    estimate: Estimate | OwnPage, folder: str | Path, settings: FitSettings | None = None
) -> tuple[Path, ...]:
    """Write the report of an estimate, with figures, tables and result.json, into a folder.

    Parameters
    ----------
    estimate : Estimate or OptimalControlEstimate
        Result of `impc.fit` or `fit_optimal_control`.
    folder : str or Path
        Output folder. It is created if necessary; an earlier report in it is replaced.
    settings : FitSettings, optional
        Only for an estimate by inverse MPC: write the report of `impc fit` with these settings,
        including intervals, other methods and left-out trials. Takes as long as `impc fit`.

    Returns
    -------
    tuple of Path
        Paths of the written files.

    Raises
    ------
    InputError
        If the estimate has no gain.
    OutputError
        If the folder is not writable or contains other results.

    Examples
    --------
    >>> import tempfile
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[0.9]], [[1]], [[1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-0.3, u_max=0.3)
    >>> truth = impc.Controller(plant, impc.Weights(1, 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1.0], steps=20).x)
    >>> found = impc.fit(impc.Problem(plant, bounds, 3, [trial]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in impc.report(found, folder)][:2]
    ['report.html', 'result.json']
    """
    place = Path(folder)
    if not isinstance(estimate, Estimate):
        with owned(place, "report"):
            return write_files(place, estimate.page(Provenance(_CALLER)).files())
    if settings is not None and estimate.method != _OURS:
        raise InputError(
            "settings", f"need an estimate by {_OURS}, got {estimate.method}", "leave settings out"
        )
    if estimate.K is None:
        raise InputError("estimate", f"has no gain: {estimate.reason}", "use another method")
    if settings is None:
        document = _document(evaluate_method(estimate, estimate.problem.bounds))
    else:
        label = method_label(_OURS)
        kept = FitProgress(estimate=lambda name, make: estimate if name == label else make())
        result = fit_recordings(estimate.problem, settings, kept)
        document = fit_report(result, Provenance(_CALLER))
    with owned(place, "report"):
        return write_files(place, document.files())


def _document(fit: MethodFit) -> Report:
    """The report of a comparison with a single method, headed by the first trial."""
    problem, label = fit.estimate.problem, method_label(fit.name)
    page = compare_report(problem, [fit], Provenance(_CALLER))
    page = replace(page, window=f"impc: {label}", kind="estimate of one method")
    if page.verdict.level is Level.RED:
        return page
    return replace(
        page,
        sections=[*page.sections, Section("Gain and cost weights", controller_findings(fit))],
        meta=(label, *page.meta[2:]),
        hero=_PICTURE,
        figures={"trial-1": lambda: movement_figure(fit, 0)},
        data={**page.data, "starts": problem.starts, "logarithms": problem.logarithms},
    )
