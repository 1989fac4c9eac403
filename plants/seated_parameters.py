"""Parameters of the seated-balance plant with their sources.

They replace those of Table 3.2, which are not available.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from plants._checks import finite_number


def _quantity(
    default: float, unit: str, origin: str, known: Any = 0.0, words: str = "", **limit: float
) -> Any:
    """Declare a dataclass field with unit, origin, uncertainty, words and limits in its metadata.

    `known` is the standard deviation between persons, in the unit or as "5 %"; `limit` has the
    bounds ``least``, ``above`` and ``most`` of `plants._checks.finite_number`.
    """
    about = {"unit": unit, "origin": origin, "known": known, "words": words, "limit": limit}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class SeatedBalanceParameters:
    """Parameters of a person on a tilting seat: bodies, joint, robot, delay, muscle.

    The lower body (pelvis, legs and seat) turns about the pivot of the seat, the upper body (trunk
    above the navel, head and arms) about the lumbar joint. The defaults are those of a man of
    79.7 kg and 1.66 m; the dissertation's own values (Table 3.2) are not available. The metadata of
    each field has its unit, its standard deviation between persons, and its origin: *regressed* on
    body mass and height, *measured* by others, or *chosen* here without a source.

    Regressed inertias of limbs have a standard error of 13 to 21 % (Yeadon and Morlock 1989), those
    of the trunk less; masses by X-ray absorption differ from regressions by 3 to 10 % (Rossi 2013),
    more in obese persons. The deviations of stiffness and delay reflect the range of their sources;
    those of l1, c_h and tau_m are assumed.

    Attributes
    ----------
    m1 : float
        Mass of the lower body, kg. Regressed: de Leva 1996, pelvis and legs 50.89 % of body mass,
        plus a seat of 20 kg (chosen).
    m2 : float
        Mass of the upper body, kg. Regressed: de Leva 1996, 49.11 % of body mass.
    l1 : float
        Height of the centre of mass of the lower body above the pivot, m; negative if below.
        Regressed, with a chosen layout of the seat.
    l2 : float
        Height of the centre of mass of the upper body above the lumbar joint, m. Regressed, with
        folded arms (chosen).
    l12 : float
        Height of the lumbar joint above the pivot, m. Regressed, with a pivot 0.05 m below the
        surface of the seat (chosen).
    J1 : float
        Moment of inertia of the lower body about its centre of mass in the frontal plane, kg m^2.
        Regressed, with a radius of gyration of the seat of 0.25 m (chosen).
    J2 : float
        Moment of inertia of the upper body about its centre of mass in the frontal plane, kg m^2.
        Regressed.
    k_h : float
        Stiffness of the lumbar joint, N m/rad. Measured in passive lateral bending: data of
        Gombatto in the review PMC9293810, Table 3, 14 N m/rad in the first quarter of the range and
        36 to 43 in the second; a value in between.
    c_h : float
        Damping of the lumbar joint, N m s/rad. Chosen.
    k_r : float
        Stiffness of the seat by the robot, N m/rad. Chosen; the dissertation sets twice the
        critical stiffness of each subject.
    c_r : float
        Damping of the seat by the robot, N m s/rad. Chosen.
    tau_d : float
        Delay from command to muscle, s. Chosen; plausible range 0.06 to 0.1.
    tau_m : float
        Time constant of the muscle, s. Chosen.
    gravity : float
        Acceleration of gravity, m/s^2. Chosen: 9.81.

    Raises
    ------
    ValueError
        If a value is not finite or out of range: l2, l12, masses, inertias and times are positive;
        stiffness, damping and gravity are not negative.
    """

    m1: float = _quantity(
        60.6, "kg", "regressed", "3 %", "mass of pelvis, legs and seat", above=0.0
    )
    m2: float = _quantity(39.1, "kg", "regressed", "4 %", "mass of trunk, head and arms", above=0.0)
    l1: float = _quantity(
        0.058, "m", "regressed", 0.015, "centre of mass of the lower body above the pivot"
    )
    l2: float = _quantity(
        0.263, "m", "regressed", "5 %", "centre of the trunk above the joint", above=0.0
    )
    l12: float = _quantity(
        0.279, "m", "regressed", "5 %", "lumbar joint above the pivot", above=0.0
    )
    J1: float = _quantity(
        2.53, "kg m²", "regressed", "12 %", "inertia of the lower body", above=0.0
    )
    J2: float = _quantity(
        1.34, "kg m²", "regressed", "12 %", "inertia of the upper body", above=0.0
    )
    k_h: float = _quantity(30.0, "N m/rad", "measured", "35 %", "lumbar stiffness", least=0.0)
    c_h: float = _quantity(2.5, "N m s/rad", "chosen", "50 %", "lumbar damping", least=0.0)
    k_r: float = _quantity(120.0, "N m/rad", "chosen", "2 %", "stiffness of the seat", least=0.0)
    c_r: float = _quantity(5.0, "N m s/rad", "chosen", "5 %", "damping of the seat", least=0.0)
    tau_d: float = _quantity(0.08, "s", "chosen", 0.01, "delay from command to muscle", above=0.0)
    tau_m: float = _quantity(0.06, "s", "chosen", "25 %", "time constant of the muscle", above=0.0)
    gravity: float = _quantity(9.81, "m/s²", "chosen", 0.0, "acceleration of gravity", least=0.0)

    @property
    def uncertainty(self) -> dict[str, float | str]:
        """Standard deviations by name, of positive quantities that are not exact."""
        known = {each.name: each.metadata["known"] for each in fields(self)}
        return {name: how for name, how in known.items() if how and getattr(self, name) > 0}

    def __post_init__(self) -> None:
        for each in fields(self):
            remedy, limit = f"give it in {each.metadata['unit']}", each.metadata["limit"]
            number = finite_number(each.name, getattr(self, each.name), remedy, **limit)
            object.__setattr__(self, each.name, number)  # the dataclass is frozen
