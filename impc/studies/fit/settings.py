"""Settings of a fit: the [fit] table of a configuration (docs/ref/settings.md)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from impc.control.named_solver import COMPILED, require_solver
from impc.errors import InputError
from impc.files.configuration import FILL_IN, converted, require_known
from impc.inverse.methods import method_named

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from impc.files.plant_sources import PlantSource

# Fewest replicates for percentiles of 95 %.
_FEWEST = 20
# Settings that not every command supports.
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
_PAGE = "docs/ref/settings.md"

#: Methods that a fit compares with inverse MPC by default (docs/howto/compare.md).
BESIDE = ("feedback_gain", "inverse_lqr", "inverse_lqr_output", "clipped_lqr")

Length = Annotated[int, Meta(ge=1, le=5000)]  # Horizon in samples
Rate = Annotated[float, Meta(ge=0)]  # 1/s
T = TypeVar("T")


class StructureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Structure of the cost weights (docs/howto/weights.md).

    Attributes
    ----------
    Q : str or list of str
        Penalised features of the states: "diagonal" (one cost weight for each state), "full" (all
        entries of Q), "outputs" (one cost weight for each output), or a list of features such as
        "theta2 - 0.5 theta1" with one cost weight each.
    R : str or list of str
        The same for the commands: "diagonal", "full" or a list of features.
    over : list of str, optional
        Features that "diagonal" or "full" of Q refers to. Not given: all states.
    name : str, optional
        Name of the structure in tables and sentences.
    """

    Q: str | list[str] = "diagonal"
    R: str | list[str] = "diagonal"
    over: list[str] | None = None
    name: str | None = None


class ObserverSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Senses of a person and noise in the loop (docs/why/output_feedback.md).

    Attributes
    ----------
    sensed : list of str
        Signals that the person senses with noise: states, outputs, or linear combinations of them.
        Empty: the person observes all states exactly.
    motor : bool
        Whether the commands have additive noise; its standard deviation is estimated.
    share : bool
        Whether the commands have signal-dependent noise, proportional to the command; its
        proportion is estimated.
    process : bool
        Whether the states have process noise; its standard deviation is estimated.
    known : bool
        Whether the person knows the perturbation.
    profiles : bool
        Whether weakly identified gains and noise standard deviations get profile-likelihood
        intervals. This takes ten minutes or more on the seat.
    """

    sensed: list[str] = []
    motor: bool = True
    share: bool = False
    process: bool = False
    known: bool = True
    profiles: bool = False


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit: the [fit] table.

    Attributes
    ----------
    horizon : int
        Prediction horizon of the controller in samples.
    u_max : float or list of float, optional
        Largest magnitude of each input, in its unit. Not given: no limit.
    bounded_states : dict of str to float or "data"
        Largest magnitude of states by name, in SI units. "data": the largest recorded value of the
        output of that name times `margin` (3.22).
    margin : float
        Factor of "data" in `bounded_states`. With 1 the bound equals the recorded maximum, so that
        the fitted controller reaches it even if the person had no such bound.
    terminal_set : bool or "auto"
        Whether the controller has the maximal invariant set as terminal set. "auto": no terminal
        set, unless the fit without it leaves more than white noise and the fit with it is better.
    free : list of str
        Physical parameters of the plant that are fitted with the gain (3.19); also "observer_rate"
        or "observer_rate.<disturbance>" if that rate is given.
    rates : bool or dict of str to float
        Whether the controller decides on changes of the commands (`with_rates`). A table also sets
        limits of the change per sample by command name, in the unit of the command. `u_max` remains
        the limit of the commands.
    observer_rate : float or dict of str to float, optional
        Rate in 1/s at which the controller learns persistent disturbances (`with_observer`), for
        all or by name; inf: they are known at once. Not given: the controller ignores them.
    preview : int
        Number of samples that all targets are known ahead (`with_preview`).
    offsets : list of str
        Outputs with an unknown constant offset in each trial.
    signal_errors : dict of str to list of str
        Outputs and disturbances with an unknown error in each trial, by kind: "offset", "drift",
        "scale" (of the values), "shift" (positive: the output is recorded late, or the disturbance
        acts later than recorded) or "clock" (share of the time by which that delay grows).
    feedback_states : list of str
        States whose gains the dissertation's preliminary estimate (3.19), (3.20) fits. Empty: no
        preliminary estimate.
    settle : float
        Time in s at the start of a left-out trial that is used to estimate its initial state and
        is not counted in its VAF.
    held_out : bool
        Whether each trial is also predicted by a fit to the other trials.
    replicates : int
        Number of bootstrap replicates, which resample residuals in moving blocks: 0 or at least 20.
    seed : int
        Seed of the bootstrap.
    profiles : list of str
        Entries of the gain, K.<control>.<state>, and free parameters that get profile-likelihood
        intervals.
    intent_draws : bool
        Whether comparisons of cost are tried on other gains that the recordings allow. With false,
        no comparison is decided.
    unknown_limit : bool
        Whether the limit of each input is estimated too.
    horizons : list of int
        Other horizons in samples to compare with; adds a fit without limit to the comparison.
    methods : list of str
        Methods that are compared with inverse MPC, by name.
    structure : StructureSettings, optional
        Structure of the cost weights: the table [fit.structure]. Not given: any weights, no test.
        With [fit.observer], the gain is restricted to gains of such weights.
    structures : list of StructureSettings
        Other structures to compare with.
    body : str
        Equations of motion in all simulations: "nonlinear" (those of the plant, if it has any) or
        "linear" (its matrices).
    solver : str
        Solver of the controller's quadratic programs: compiled, daqp, qpoases or ipopt.
    observer : ObserverSettings, optional
        Model with sensory and motor noise: the table [fit.observer]. Not given: no such model.

    Examples
    --------
    >>> import impc
    >>> settings = impc.FitSettings(horizon=10, u_max=1.2, held_out=False)
    >>> settings.horizon, settings.margin
    (10, 1.2)
    """

    horizon: Length = 20
    u_max: float | list[float] | None = None
    bounded_states: dict[str, float | str] = field(default_factory=dict)
    margin: Annotated[float, Meta(ge=1, le=1000)] = 1.2
    terminal_set: bool | Literal["auto"] = "auto"
    free: list[str] = field(default_factory=list)
    rates: bool | dict[str, Annotated[float, Meta(gt=0)]] = False
    observer_rate: Rate | dict[str, Rate] | None = None
    preview: Annotated[int, Meta(ge=0, le=1000)] = 0
    offsets: list[str] = field(default_factory=list)
    signal_errors: dict[str, list[str]] = field(default_factory=dict)
    feedback_states: list[str] = field(default_factory=list)
    settle: Annotated[float, Meta(ge=0, le=1_000_000)] = 1.0
    held_out: bool = True
    replicates: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    profiles: list[str] = field(default_factory=list)
    intent_draws: bool = True
    unknown_limit: bool = False
    horizons: list[Length] = field(default_factory=list)
    methods: list[str] = field(default_factory=lambda: list(BESIDE))
    structure: StructureSettings | None = None
    structures: list[StructureSettings] = field(default_factory=list)
    body: Literal["nonlinear", "linear"] = "nonlinear"
    solver: str = COMPILED
    observer: ObserverSettings | None = None


def plain_settings(settings: FitSettings) -> dict[str, Any]:
    """Settings as built-in Python types, for result.json."""
    found: dict[str, Any] = msgspec.to_builtins(settings, enc_hook=lambda number: number.item())
    return found


def require_used(settings: FitSettings, used: Collection[str], command: str) -> None:
    """Raise InputError if a setting is given that the command does not use."""
    usual = FitSettings()
    for name in _OF_SOME:
        if name not in used and getattr(settings, name) != getattr(usual, name):
            raise InputError(
                f"[fit] {name}",
                f"is not used by impc {command}",
                "remove the line, or use impc fit",
            )


def read_settings(name: str, kind: type[T], table: Mapping[str, Any]) -> T:
    """Convert the `table` called `name` of a file to a dataclass of this `kind`."""

    def where(path: str) -> str:
        """Format the path structure.over as "[fit.structure] over"."""
        *tables, key = path.split(".")
        return f"[{'.'.join((name, *tables))}] {key}".rstrip()

    known = (item.name for item in fields(kind))  # type: ignore[arg-type]
    require_known(where, table, known, "is not a setting", (name,))
    return converted(where, table, kind, f"see {_PAGE}", (name,))


def fit_settings(table: Mapping[str, Any]) -> FitSettings:
    """Read the [fit] table of a configuration."""
    for name, value in table.items():
        if value == FILL_IN:
            raise InputError(
                f"[fit] {name}", f"is still {FILL_IN!r}", "fill it in, or remove the line"
            ).at("", "fit", name)
    settings = read_settings("fit", FitSettings, table)
    if 0 < settings.replicates < _FEWEST:
        raise InputError(
            "[fit] replicates", f"got {settings.replicates}", f"give 0 or at least {_FEWEST}"
        )
    limits = settings.u_max if isinstance(settings.u_max, list) else [settings.u_max]
    given: list[tuple[str, Any]] = [("u_max", limit) for limit in limits]
    given += [(f"bounded_states {name}", item) for name, item in settings.bounded_states.items()]
    for name, limit in given:  # it is squared and divided by
        if isinstance(limit, float) and not (1e-100 <= limit <= 1e100 or limit == np.inf):
            raise InputError(f"[fit] {name}", f"got {limit}", "give at least 1e-100, at most 1e100")
    for name in ("free", "offsets", "feedback_states", "profiles", "horizons", "methods"):
        items = getattr(settings, name)
        twice = [item for index, item in enumerate(items) if item in items[:index]]
        if twice:
            raise InputError(f"[fit] {name}", f"contains {twice[0]} twice", "list each name once")
    for name in settings.methods:
        method_named(name)
    return replace(settings, solver=require_solver(settings.solver))


def missing(settings: FitSettings, source: PlantSource) -> str:
    """Settings that were not given, and the consequence, in one line; empty if complete."""
    parts = []
    if settings.u_max is None:
        parts.append("u_max: without a limit of the command, inverse MPC equals inverse LQR")
    typical = source.assumed()
    own = [name for name in typical if name not in settings.free]
    if own:
        values = ", ".join(f"{name} {typical[name]}" for name in own)
        parts.append(f"the subject's own {' and '.join(own)}: the gains assume {values}")
    return f"Not given: {'; '.join(parts)}." if parts else ""
