"""Methods whose code is in higher modules: named here, imported when first used.

A class that calls `attach` declares them for type checkers under `if TYPE_CHECKING`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

#: Class -> method -> module of impc and function in it.
METHODS = {
    "Controller": {"simulate": "control.feasibility:simulate_from"},
    "Estimate": {
        "vaf": "assess.assessments:estimate_vaf",
        "intervals": "assess.printed_gain:interval_table",
        "continuous_gain": "assess.printed_gain:continuous_interval_table",
        "identifiability": "assess.weights_test:estimate_identifiability",
        "summary": "reporting.estimate_text:summary",
        "plot": "reporting.estimate_text:plot",
        "save": "files.saved_estimates:save_estimate",
        "_repr_html_": "reporting.estimate_text:as_html",
    },
    "OptimalControlEstimate": {"page": "nonlinear.page:estimate_report"},
    "OutputFeedbackFit": {"doubts": "output_feedback.doubts:fit_doubts"},
}
#: Those that are read without a call.
PROPERTIES = {"doubts", "vaf"}


class _Named:
    """Method given by name; at the first use its function takes its place in the class."""

    def __init__(self, name: str, place: str) -> None:
        self.name, self.place = name, place

    def __get__(self, instance: object, owner: type) -> Any:
        module, _, function = self.place.partition(":")
        found = getattr(import_module(f"impc.{module}"), function)
        setattr(owner, self.name, property(found) if self.name in PROPERTIES else found)
        return getattr(owner if instance is None else instance, self.name)


def attach(kind: type) -> None:
    """Give a class its methods of the table."""
    for name, place in METHODS[kind.__name__].items():
        setattr(kind, name, _Named(name, place))
