"""Settings of a fit, as the [fit] table of a configuration gives them (docs/fitting.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec
import numpy as np

from impc.control.named_solver import COMPILED, require_solver
from impc.errors import InputError, brief
from impc.files.configuration import FILL_IN
from impc.inverse.methods import method_named

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping


# Percentiles of 95 % lie between replicates only from 20 on.
_FEWEST = 20
# Least and most of each number. The most is far beyond any use: it keeps sizes and seconds numbers.
_RANGES: dict[str, tuple[float, float]] = {
    "horizon": (1, 5000),
    "margin": (1, 1000),
    "settle": (0, 1e6),
    "replicates": (0, 1_000_000),
    "seed": (0, 2**63 - 1),
}
# A limit of an input is squared and divided by: beyond these the square is no number any more.
_LIMITS = (1e-100, 1e100)
# Settings that ask for assessments which not every command makes.
_OF_SOME = (
    "feedback_states",
    "horizons",
    "methods",
    "observer",
    "profiles",
    "replicates",
    "structure",
    "structures",
    "unknown_limit",
)
_PAGES = {"fit": "docs/fitting.md", "plan": "docs/planning.md", "select": "docs/selection.md"}

#: Methods that a fit shows beside inverse MPC, which comes last (docs/fitting.md).
BESIDE = ("feedback_gain", "inverse_lqr", "inverse_lqr_output", "clipped_lqr")

T = TypeVar("T")


@dataclass(frozen=True)
class StructureSettings:
    """What may be costed, by name (`impc.model.structure`)."""

    # "diagonal", "full", for Q "outputs", or features with a price each
    Q: str | list[str] = "diagonal"
    R: str | list[str] = "diagonal"
    # Features that "diagonal" or "full" is over; all states by default
    over: list[str] | None = None
    name: str | None = None  # In tables and sentences


@dataclass(frozen=True)
class ObserverSettings:
    """How a person senses, and which noise is in the loop (`impc.output_feedback`)."""

    # Combinations of states and outputs; none for a person who sees every state
    sensed: list[str] = field(default_factory=list)
    motor: bool = True  # Whether there is such noise; its size is searched
    share: bool = False
    process: bool = False
    known: bool = True  # Whether the person knows the perturbation
    # Whether intervals of the gain and of levels that are weakly told follow the likelihood: ten
    # minutes and more on the seat
    profiles: bool = False


@dataclass(frozen=True)
class FitSettings:
    """What a user may set of a fit.

    Attributes
    ----------
    horizon : int
        N, in samples.
    u_max : float or list of float or None
        Largest magnitude of each input, in its unit; None where there is no bound.
    bounded_states : dict of str to float or "data"
        Largest magnitude of states by name, in their SI units. "data" takes the largest recorded
        value of an output of that name, or of the derivative of output y for a state `y_rate`,
        times `margin` (3.22).
    margin : float
        At 1 the bound lies on the recorded maximum, and a controller that never met a bound would
        meet one there: on the simulated seat a margin of 1 changes the angles by one to two
        hundredths of a radian, 1.05 by nothing.
    terminal_set : bool or "auto"
        Whether the controller ends in its maximal invariant set. "auto" takes what explains the
        recordings better: without it, unless that leaves more than white noise.
    free : list of str
        Physical parameters of the plant that are fitted with the gain (3.19).
    feedback_states : list of str
        States whose gains the dissertation's preliminary estimate (3.19), (3.20) fits; it is left
        out when there are none.
    settle : float
        Seconds at the start of a left-out trial that serve to find its initial state and do not
        count in its VAF.
    held_out : bool
        Whether each trial is predicted from the others.
    replicates : int
        Bootstrap replicates; 0 for none, else at least 20.
    bootstrap : "block" or "model"
        How residuals are drawn (`impc.assess.resampling`).
    seed : int
        Of the bootstrap.
    profiles : list of str
        Entries of the gain, K.<control>.<state>, and free parameters whose profile likelihood is
        wanted.
    intent_draws : bool
        Whether statements on the intent are tried on gains that the recordings allow beside the
        fitted one (`impc.assess.intent_draws`); without that none is made.
    unknown_limit : bool
        Whether the limit of each input is estimated too.
    horizons : list of int
        Other horizons, in samples, to compare with; and the fit without limit beside them.
    methods : list of str
        Methods that are shown beside inverse MPC, by their names in `impc.inverse.methods`.
    structure : StructureSettings or None
        What may be costed: the table [fit.structure]. None: any weights, and no word on it. The
        gain of a person who senses with noise keeps to gains of such weights.
    structures : list of StructureSettings
        Others, to compare it with.
    body : str
        What moves in every simulation: "nonlinear", the equations that the plant offers, where it
        does, or "linear", its matrices in any case.
    solver : str
        What solves the controller's quadratic programs (`impc.control.named_solver`).
    observer : ObserverSettings or None
        A person who senses with noise: the table [fit.observer]. None: no word on it.

    Examples
    --------
    >>> import impc
    >>> settings = impc.FitSettings(horizon=10, u_max=1.2, held_out=False)
    >>> settings.horizon, settings.margin
    (10, 1.2)
    """

    horizon: int = 20
    u_max: float | list[float] | None = None
    bounded_states: dict[str, float | str] = field(default_factory=dict)
    margin: float = 1.2
    terminal_set: bool | Literal["auto"] = "auto"
    free: list[str] = field(default_factory=list)
    feedback_states: list[str] = field(default_factory=list)
    settle: float = 1.0
    held_out: bool = True
    replicates: int = 0
    bootstrap: Literal["block", "model"] = "block"
    seed: int = 0
    profiles: list[str] = field(default_factory=list)
    intent_draws: bool = True
    unknown_limit: bool = False
    horizons: list[int] = field(default_factory=list)
    methods: list[str] = field(default_factory=lambda: list(BESIDE))
    structure: StructureSettings | None = None
    structures: list[StructureSettings] = field(default_factory=list)
    body: Literal["nonlinear", "linear"] = "nonlinear"
    solver: str = COMPILED
    observer: ObserverSettings | None = None


def require_used(settings: FitSettings, used: Collection[str], command: str) -> None:
    """Refuse what is set and not used, so that nothing is left out without a word."""
    usual = FitSettings()
    for name in _OF_SOME:
        if name not in used and getattr(settings, name) != getattr(usual, name):
            raise InputError(
                f"[fit] {name}",
                f"is not used by impc {command}",
                "take the line out, or use impc fit",
            )


def read_settings(name: str, kind: type[T], table: Mapping[str, Any]) -> T:
    """The `table` of a file that is called `name`, as a dataclass of this `kind`."""
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    unknown = [key for key in table if key not in known]
    if unknown:
        raise InputError(f"[{name}] {unknown[0]}", "is not a setting", f"known: {', '.join(known)}")
    try:
        return msgspec.convert(dict(table), kind, strict=True)
    except msgspec.ValidationError as error:
        raise InputError(f"[{name}]", str(error), f"see {_PAGES[name]}") from None


def fit_settings(table: Mapping[str, Any]) -> FitSettings:
    """Read the [fit] table of a configuration."""
    for name, value in table.items():
        if value == FILL_IN:
            raise InputError(
                f"[fit] {name}", f"is still {FILL_IN!r}", "fill it in, or take the line out"
            )
    _require_structures(table)
    settings = read_settings("fit", FitSettings, table)
    for name, (least, most) in _RANGES.items():
        _require_between(name, getattr(settings, name), least, most)
    if 0 < settings.replicates < _FEWEST:
        raise InputError(
            "[fit] replicates", f"got {settings.replicates}", f"give 0 or at least {_FEWEST}"
        )
    for length in settings.horizons:
        _require_between("horizons", length, *_RANGES["horizon"])
    limits = settings.u_max if isinstance(settings.u_max, list) else [settings.u_max]
    for limit in limits:
        if limit is not None and limit != np.inf:
            _require_between("u_max", limit, *_LIMITS)
    for name, bound in settings.bounded_states.items():
        if not isinstance(bound, str) and bound != np.inf:
            _require_between(f"bounded_states {name}", bound, *_LIMITS)
    _require_distinct(settings)
    for name in settings.methods:
        method_named(name)
    return replace(settings, solver=require_solver(settings.solver))


def _require_between(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise InputError(
            f"[fit] {name}", f"got {brief(value)}", f"give at least {least:.6g}, at most {most:.6g}"
        )


def _require_distinct(settings: FitSettings) -> None:
    for name in ("free", "feedback_states", "profiles", "horizons", "methods"):
        given = getattr(settings, name)
        twice = [item for index, item in enumerate(given) if item in given[:index]]
        if twice:
            raise InputError(f"[fit] {name}", f"names {twice[0]} twice", "name each once")


def _require_structures(table: Mapping[str, Any]) -> None:
    """Every key of the tables in the table is known: msgspec passes over those that are not."""
    others = table.get("structures", [])
    given = [table.get("structure"), *(others if isinstance(others, list) else [])]
    asked = [("structure", StructureSettings, item) for item in given]
    for name, kind, item in (*asked, ("observer", ObserverSettings, table.get("observer"))):
        known = [each.name for each in fields(kind)]
        for key in item if isinstance(item, dict) else ():
            if key not in known:
                raise InputError(
                    f"[fit.{name}] {key}", "is not a setting", f"known: {', '.join(known)}"
                )
