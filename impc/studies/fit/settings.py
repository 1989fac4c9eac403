"""Settings of a fit, as the [fit] table of a configuration gives them (docs/fitting.md)."""

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

# Percentiles of 95 % lie between replicates only from 20 on.
_FEWEST = 20
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

Length = Annotated[int, Meta(ge=1, le=5000)]  # Of a horizon, in samples
Rate = Annotated[float, Meta(ge=0)]  # 1/s
T = TypeVar("T")


class StructureSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What may be costed, by name (`impc.model.structure`)."""

    # "diagonal", "full", for Q "outputs", or features with a cost weight each
    Q: str | list[str] = "diagonal"
    R: str | list[str] = "diagonal"
    # Features that "diagonal" or "full" is over; all states by default
    over: list[str] | None = None
    name: str | None = None  # In tables and sentences


class ObserverSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a person senses, and which noise is in the loop (`impc.model.observer`)."""

    # Combinations of states and outputs; none for a person who sees every state
    sensed: list[str] = []
    motor: bool = True  # Whether there is such noise; its size is searched
    share: bool = False
    process: bool = False
    known: bool = True  # Whether the person knows the perturbation
    # Whether intervals of the gain and of levels that are weakly identified follow the likelihood:
    # ten minutes and more on the seat
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
        Physical parameters of the plant that are fitted with the gain (3.19), and
        "observer_rate", or "observer_rate.<disturbance>", where that is given.
    rates : bool or dict of str to float
        Whether the controls are changes of the commands (`with_rates`); limits of the change per
        sample by the name of a command, in its unit. `u_max` stays the limit of the commands.
    observer_rate : float or dict of str to float or None
        Rate at which the controller learns disturbances that last (`with_observer`), 1/s, of all
        or by name; infinite where it knows them. None: it takes none for lasting.
    preview : int
        Samples that all targets are known ahead (`with_preview`).
    offsets : list of str
        Outputs with an offset that is not known, one a trial (`Problem.offsets`).
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
    bootstrap : "block"
        How residuals are drawn: in moving blocks (`impc.assess.resampling`).
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
    feedback_states: list[str] = field(default_factory=list)
    settle: Annotated[float, Meta(ge=0, le=1_000_000)] = 1.0
    held_out: bool = True
    replicates: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    bootstrap: Literal["block"] = "block"
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
    """Settings as result.json has them; numbers of numpy as Python's."""
    found: dict[str, Any] = msgspec.to_builtins(settings, enc_hook=lambda number: number.item())
    return found


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

    def where(path: str) -> str:
        """The path structure.over as [fit.structure] over."""
        *tables, key = path.split(".")
        return f"[{'.'.join((name, *tables))}] {key}".rstrip()

    known = (item.name for item in fields(kind))  # type: ignore[arg-type]
    require_known(where, table, known, "is not a setting")
    return converted(where, table, kind, f"see {_PAGES[name]}")


def fit_settings(table: Mapping[str, Any]) -> FitSettings:
    """Read the [fit] table of a configuration."""
    for name, value in table.items():
        if value == FILL_IN:
            raise InputError(
                f"[fit] {name}", f"is still {FILL_IN!r}", "fill it in, or take the line out"
            )
    if table.get("bootstrap") == "model":
        raise InputError("[fit] bootstrap", '"model" was removed', 'use "block"')
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
    _require_distinct(settings)
    for name in settings.methods:
        method_named(name)
    return replace(settings, solver=require_solver(settings.solver))


def _require_distinct(settings: FitSettings) -> None:
    for name in ("free", "offsets", "feedback_states", "profiles", "horizons", "methods"):
        given = getattr(settings, name)
        twice = [item for index, item in enumerate(given) if item in given[:index]]
        if twice:
            raise InputError(f"[fit] {name}", f"names {twice[0]} twice", "name each once")


def missing(settings: FitSettings, source: PlantSource) -> str:
    """What was not given, and what that excludes, in one line; empty where nothing is missing."""
    parts = []
    if settings.u_max is None:
        parts.append("u_max: without a limit of the command inverse MPC is inverse LQR")
    typical = source.assumed()
    own = [name for name in typical if name not in settings.free]
    if own:
        values = ", ".join(f"{name} {typical[name]}" for name in own)
        parts.append(f"the subject's own {' and '.join(own)}: the gains are those of {values}")
    return f"Not given: {'; '.join(parts)}." if parts else ""
