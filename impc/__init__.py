"""Inverse model predictive control: the feedback gain and cost weights behind recorded movements.

The public names are listed by subject in docs/ref/api.md. A name is loaded from its module when it
is first used: `import impc` itself loads no other library.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from impc.assess.expected import expected_intervals as expected_intervals
    from impc.assess.printed_gain import command_regression as command_regression
    from impc.assess.variance_accounted_for import vaf as vaf
    from impc.assess.weights_test import identifiability as identifiability
    from impc.checking import replace as replace
    from impc.control.casadi_controller import mpc_function as mpc_function
    from impc.control.closed_loop import simulate_and_differentiate as simulate_and_differentiate
    from impc.control.constraint_rows import directions as directions
    from impc.control.controller import Controller as Controller
    from impc.control.feasibility import require_complete as require_complete
    from impc.control.loop_function import closed_loop_function as closed_loop_function
    from impc.control.simulation import Simulation as Simulation
    from impc.control.simulation import Status as Status
    from impc.control.simulation import scenario as scenario
    from impc.control.terminal_set import TerminalSet as TerminalSet
    from impc.control.terminal_set import maximal_invariant_set as maximal_invariant_set
    from impc.errors import BoundsError as BoundsError
    from impc.errors import DataError as DataError
    from impc.errors import ImpcError as ImpcError
    from impc.errors import InfeasibleError as InfeasibleError
    from impc.errors import InputError as InputError
    from impc.errors import OutputError as OutputError
    from impc.errors import PlantError as PlantError
    from impc.errors import SolverError as SolverError
    from impc.errors import WeightsError as WeightsError
    from impc.files.configuration import read_configuration as read_configuration
    from impc.files.formats import read_table as read_table
    from impc.files.formats import write_table as write_table
    from impc.files.reading import read_recordings as read_recordings
    from impc.files.saved_estimates import load as load
    from impc.files.table import make_table as make_table
    from impc.inverse.equivalent_weights import least_condition_weights as least_condition_weights
    from impc.inverse.equivalent_weights import other_weights as other_weights
    from impc.inverse.estimates import Estimate as Estimate
    from impc.inverse.inverse_lqr import inverse_lqr_gradient as inverse_lqr_gradient
    from impc.inverse.inverse_lqr import inverse_lqr_lmi as inverse_lqr_lmi
    from impc.inverse.methods import fit as fit
    from impc.inverse.problem import Problem as Problem
    from impc.inverse.solution_set import gain_fibre as gain_fibre
    from impc.inverse.table31 import table_3_1 as table_3_1
    from impc.model.bounds import Bounds as Bounds
    from impc.model.foresight import with_observer as with_observer
    from impc.model.foresight import with_preview as with_preview
    from impc.model.plant import Plant as Plant
    from impc.model.plant_family import PlantFamily as PlantFamily
    from impc.model.rates import with_rates as with_rates
    from impc.model.recordings import Label as Label
    from impc.model.recordings import Recording as Recording
    from impc.model.riccati import solve_lqr as solve_lqr
    from impc.model.structure import Structure as Structure
    from impc.model.targets import steady_state as steady_state
    from impc.model.weights import Weights as Weights
    from impc.model.weights import weight_error as weight_error
    from impc.nonlinear.fit import fit_optimal_control as fit_optimal_control
    from impc.nonlinear.problem import OptimalControlProblem as OptimalControlProblem
    from impc.output_feedback.fit import fit_output_feedback as fit_output_feedback
    from impc.output_feedback.observer import Observer as Observer
    from impc.studies.estimate_page import report as report
    from impc.studies.fit.asked import fit_problem as fit_problem
    from impc.studies.fit.settings import FitSettings as FitSettings

    __version__: str

_NAMES = {
    "assess.printed_gain": "command_regression",
    "assess.expected": "expected_intervals",
    "assess.weights_test": "identifiability",
    "assess.variance_accounted_for": "vaf",
    "checking": "replace",
    "control.casadi_controller": "mpc_function",
    "control.closed_loop": "simulate_and_differentiate",
    "control.constraint_rows": "directions",
    "control.controller": "Controller",
    "control.feasibility": "require_complete",
    "control.loop_function": "closed_loop_function",
    "control.simulation": "Simulation Status scenario",
    "control.terminal_set": "TerminalSet maximal_invariant_set",
    "errors": "BoundsError DataError ImpcError InfeasibleError InputError OutputError PlantError"
    " SolverError WeightsError",
    "files.configuration": "read_configuration",
    "files.formats": "read_table write_table",
    "files.reading": "read_recordings",
    "files.saved_estimates": "load",
    "files.table": "make_table",
    "inverse.equivalent_weights": "least_condition_weights other_weights",
    "inverse.estimates": "Estimate",
    "output_feedback.fit": "fit_output_feedback",
    "inverse.inverse_lqr": "inverse_lqr_gradient inverse_lqr_lmi",
    "inverse.methods": "fit",
    "inverse.problem": "Problem",
    "inverse.solution_set": "gain_fibre",
    "inverse.table31": "table_3_1",
    "model.bounds": "Bounds",
    "output_feedback.observer": "Observer",
    "model.foresight": "with_observer with_preview",
    "model.plant": "Plant",
    "model.plant_family": "PlantFamily",
    "model.rates": "with_rates",
    "model.recordings": "Label Recording",
    "model.riccati": "solve_lqr",
    "model.structure": "Structure",
    "model.targets": "steady_state",
    "model.weights": "Weights weight_error",
    "nonlinear.fit": "fit_optimal_control",
    "nonlinear.problem": "OptimalControlProblem",
    "studies.estimate_page": "report",
    "studies.fit.settings": "FitSettings",
    "studies.fit.asked": "fit_problem",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_MODULES)  # noqa: PLE0605 - names of the table above
if not TYPE_CHECKING:  # a type checker would accept any attribute

    def __getattr__(name: str) -> object:
        """Load a public name from its module, once (PEP 562)."""
        if name == "__version__":
            found = import_module("importlib.metadata").version("impc")
        elif name in _MODULES:
            try:
                found = getattr(import_module(f"impc.{_MODULES[name]}"), name)
            except ModuleNotFoundError as missing:
                if not (missing.name or "").startswith("impc."):
                    raise
                error = import_module("impc.errors").ImpcError  # an optional subpackage
                raise error(
                    f"impc.{name}",
                    f"needs {missing.name}, which is not installed",
                    "install the complete package",
                ) from None
        else:
            raise AttributeError(f"module 'impc' has no attribute {name!r}")
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return [*__all__, "__version__"]
