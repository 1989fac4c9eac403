"""Every method for the weights behind recordings, by the name that it has everywhere.

The names are those in result.json, the labels those of tables and figures; commands and tests
choose from `METHODS`. In which units a method works, and from where it starts, is its `Groundwork`:
Table 3.1 in the units of the plant, or docs/fitting.md in natural coordinates.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from impc.arrays import frozen
from impc.checking import checked, replace
from impc.errors import ImpcError, InputError
from impc.inverse.delayed_feedback import preliminary_gain
from impc.inverse.estimates import Estimate, Goodness, Status, goodness
from impc.inverse.gain_search import GainFit
from impc.inverse.groundwork import Found, Groundwork, NaturalUnits, PlantUnits, regulator
from impc.inverse.problem import EXPLAINED, recorded_size
from impc.inverse.structured_fit import fit_structured
from impc.model.bounds import Bounds
from impc.model.weights import normalised

if TYPE_CHECKING:
    from collections.abc import Sequence

    from impc.inverse.problem import Problem


@dataclass(frozen=True)
class Method:
    """A way from recordings to a controller."""

    name: str  # In result.json, in TOML and at the command line
    label: str  # In tables and figures
    sentence: str  # For readers who do not know it
    # The problem as posed -> as the method sees it: inverse LQR knows no bounds
    sees: Callable[[Problem], Problem]
    find: Callable[[Groundwork], Found | GainFit | Estimate]  # What it finds on a `Groundwork`

    def estimate(self, ground: Groundwork) -> Estimate:
        """Run the method; one that ends without a gain says why in its estimate.

        Parameters
        ----------
        ground : Groundwork
            What it starts from; its making is not in the method's time.
        """
        started = time.perf_counter()
        try:
            found = self.find(ground)
        except ImpcError as error:
            seen = self.sees(ground.known)
            return _nothing(self.name, seen, str(error), time.perf_counter() - started)
        if isinstance(found, Estimate):
            return found
        return estimate_of(ground, self.name, found, started)


def estimate_of(
    ground: Groundwork, name: str, found: Found | GainFit, started: float | None = None
) -> Estimate:
    """What a method found, simulated: its estimate."""
    if isinstance(found, GainFit):
        found = Found(np.array(found.K), None, found.evaluations, problem=found.problem.known())
    S = ground.metric if found.S is None else found.S
    settled = ground.settle(found.problem or METHODS[name].sees(ground.known), found.K, S)
    seconds = 0.0 if started is None else time.perf_counter() - started
    misfit, fit = goodness(settled, found.K, S)
    return Estimate(
        name,
        settled,
        frozen(found.K),
        frozen(S),
        None if found.weights is None else normalised(found.weights),
        frozen(S[None]),
        misfit,
        ground.noise,
        _status(found, settled, misfit),
        found.reason,
        found.evaluations,
        seconds,
        fit,
    )


def _status(found: Found, settled: Problem, misfit: float) -> Status:
    if found.weights is None:
        return Status.GAIN_ONLY
    if misfit <= EXPLAINED * recorded_size(settled):
        return Status.EXPLAINED
    return Status.SETTLED if found.settled else Status.STOPPED


def _nothing(name: str, seen: Problem, reason: str, seconds: float) -> Estimate:
    m, none = seen.plant.m, float("nan")
    metrics = frozen(np.zeros((0, m, m)))
    nothing = Goodness(white=True, softened=0, samples=0, rank=0)
    return Estimate(
        name, seen, None, None, None, metrics, none, none, Status.NONE, reason, 0, seconds, nothing
    )


def _as_posed(problem: Problem) -> Problem:
    return problem


def _without_bounds(problem: Problem) -> Problem:
    return problem.without_bounds()


def _cut_off(problem: Problem) -> Problem:
    """A horizon of one sample without state bounds or terminal set: cut off, no foresight."""
    limits = Bounds(problem.plant, u_min=problem.bounds.u_min, u_max=problem.bounds.u_max)
    return replace(problem, bounds=limits, horizon=1, terminal_set=False)


def _clipped(ground: Groundwork) -> Found:
    assert isinstance(ground, NaturalUnits)  # no row of Table 3.1
    return Found(np.array(ground.fitted.gain), ground.fitted.weights)


def _preliminary(ground: Groundwork) -> Found | Estimate:
    assert isinstance(ground, NaturalUnits)  # no row of Table 3.1
    found = preliminary_gain(ground.problem, ground.feedback_states)
    return Found(np.array(found.K), problem=found.problem.known())


def _structured(ground: Groundwork) -> Estimate:
    structure = ground.problem.structure
    if structure is None:
        raise InputError(
            "structured", "the problem names no structure", "give Problem(..., structure=...)"
        )
    assert isinstance(ground, NaturalUnits)  # no row of Table 3.1
    return fit_structured(ground.problem, structure, ground.fitted)


_TABLE = (
    Method(
        "preliminary",
        "preliminary gains and parameters (3.19)",
        "Gains on a few states alone (3.20), fitted together with the physical parameters.",
        _without_bounds,
        _preliminary,
    ),
    Method(
        "feedback_gain",
        "feedback gain, no bounds (3.12)",
        "The fixed gain K of u = -Kx whose loop fits the outputs best (3.12). It knows no bounds "
        "and has no weights.",
        _without_bounds,
        lambda ground: ground.feedback,
    ),
    Method(
        "inverse_lqr_lmi",
        "inverse LQR, LMI",
        "Weights whose optimal gain is exactly that K, of least condition number. There may be "
        "none, and for a gain fitted to noise there are none as a rule: then the program is "
        "infeasible.",
        _without_bounds,
        lambda ground: regulator(ground, ground.lmi.weights),
    ),
    Method(
        "inverse_lqr_gradient",
        "inverse LQR, gradient",
        "Weights whose optimal gain comes nearest to that K.",
        _without_bounds,
        lambda ground: regulator(ground, ground.gradient.weights),
    ),
    Method(
        "inverse_lqr_auxiliary",
        "inverse LQR, gain penalty (3.7)",
        "The same, with a price on the condition number that keeps the weights away from singular.",
        _without_bounds,
        lambda ground: regulator(ground, ground.auxiliary),
    ),
    Method(
        "inverse_lqr",
        "inverse LQR, lines 2 to 7 of Table 3.1",
        "Weights with exactly that K where there are any, otherwise those of the gain penalty "
        "(3.7): where Table 3.1 starts inverse MPC.",
        _without_bounds,
        lambda ground: regulator(ground, ground.lmi.weights or ground.auxiliary),
    ),
    Method(
        "inverse_lqr_output",
        "inverse LQR, output penalty (3.16)",
        "Weights whose optimal gain, without bounds, fits the outputs themselves best.",
        _without_bounds,
        lambda ground: ground.output(),
    ),
    Method(
        "clipped_lqr",
        "LQR of inverse MPC, clipped",
        "The regulator of inverse MPC, its command cut off at the bounds.",
        _cut_off,
        _clipped,
    ),
    Method(
        "inverse_mpc_reduced",
        "inverse MPC, reduced",
        "First the gain of the bounded controller that fits the outputs best, then the weights of "
        "least condition number that have this gain, if any.",
        _as_posed,
        lambda ground: ground.reduced(),
    ),
    Method(
        "inverse_mpc",
        "inverse MPC, direct (3.6)",
        "Weights whose controller, with its bounds, fits the outputs best.",
        _as_posed,
        lambda ground: ground.inverse_mpc(),
    ),
    Method(
        "structured",
        "inverse MPC within a structure",
        "Prices of the features that the user names, whose controller, with its bounds, fits the "
        "outputs best.",
        _as_posed,
        _structured,
    ),
)

#: Every method by its name. A new one is one more entry.
METHODS: dict[str, Method] = {method.name: method for method in _TABLE}


@checked
def method_named(name: str) -> Method:
    """Return the method of the registry that is called `name`."""
    if name == "inverse_kkt":
        raise InputError(
            "method", "inverse_kkt was removed", "take it out; experiments/inverse_kkt.py has it"
        )
    if name not in METHODS:
        raise InputError("method", f"got {name!r}", f"choose one of {', '.join(METHODS)}")
    return METHODS[name]


@checked
def estimate(
    problem: Problem,
    method: str = "inverse_mpc",
    progress: Callable[[str], None] | None = None,
) -> Estimate:
    """Find the controller behind recordings by one method.

    Parameters
    ----------
    problem : Problem
    method : str
        A key of `METHODS`.
    progress : callable, optional
        Told the name of each stage when it is done, such as `print`: every method but inverse MPC
        begins with it.

    Raises
    ------
    InputError
        When there is no such method.
    WeightsError, SolverError
        When no regulator can be simulated on the recordings.

    Examples
    --------
    >>> import control
    >>> import impc
    >>> plant = impc.Plant(control.ss([[2, -1], [1, 0.2]], [[1], [0]], [[1, 0], [0, 1]], 0, 1))
    >>> bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    >>> truth = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, horizon=3)
    >>> trial = impc.Recording(plant, truth.simulate([1, 3], steps=20).x)
    >>> found = impc.estimate(impc.Problem(plant, bounds, 3, [trial]), "inverse_mpc")
    >>> found.weights.Q.round(6) + 0.0
    array([[1., 0.],
           [0., 1.]])
    """
    ground, name = NaturalUnits(problem), method_named(method).name
    if progress is not None and name != "inverse_mpc":
        _ = ground.fitted
        progress("inverse_mpc")
    found = estimate_all(ground, [name])[name]
    if progress is not None:
        progress(name)
    return found


def estimate_all(
    ground: Groundwork,
    names: Sequence[str],
) -> dict[str, Estimate]:
    """Run methods on the same recordings."""
    found = {}
    for name in names:
        make = functools.partial(METHODS[name].estimate, ground)
        if isinstance(ground, PlantUnits) or name == "inverse_mpc":
            found[name] = make()
        else:
            found[name] = ground.remember(name, make)
    return found
