"""What the seated-balance plant is made of: its parameters and its limits, with their origins.

They stand for those of Table 3.2, which are lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from plants._checks import finite_number

__all__ = ["Quantities", "SeatedBalanceLimits", "SeatedBalanceParameters", "quantity"]


def quantity(
    default: float, unit: str, origin: str, known: float | str = 0.0, **limit: float
) -> Any:
    """Declare a dataclass field with its unit, its origin, how well it is known, and its limits.

    Parameters
    ----------
    default : float
        Value when none is given.
    unit, origin : str
        Kept in the metadata of the field.
    known : float or str
        Standard deviation between persons of whom no more is known: in the unit, or as "5 %".
    **limit : float
        ``least``, ``above``, ``most`` of `plants._checks.finite_number`.
    """
    return field(
        default=default, metadata={"unit": unit, "origin": origin, "known": known, "limit": limit}
    )


class Quantities:
    """Base of frozen dataclasses of quantities: checks every field, keeps it as a float."""

    @property
    def uncertainty(self) -> dict[str, float | str]:
        """How well each is known that is positive and not known exactly, by name."""
        each = fields(self)  # type: ignore[arg-type]  # as below
        known = {one.name: one.metadata["known"] for one in each}
        return {name: how for name, how in known.items() if how and getattr(self, name) > 0}

    def __post_init__(self) -> None:
        for each in fields(self):  # type: ignore[arg-type]  # the subclasses are dataclasses
            given = getattr(self, each.name)
            unit = each.metadata["unit"]
            number = finite_number(each.name, given, f"give it in {unit}", **each.metadata["limit"])
            object.__setattr__(self, each.name, number)  # the only way into a frozen dataclass


@dataclass(frozen=True)
class SeatedBalanceParameters(Quantities):
    """A person on a seat that tilts sideways: two bodies, lumbar joint, robot, delay, muscle.

    The lower body (pelvis, legs and seat) turns about the pivot of the seat, the upper body
    (trunk above the navel, head and arms) about the lumbar joint. The defaults stand for a man of
    79.7 kg and 1.66 m; the dissertation's own values (Table 3.2) are lost. The metadata of each
    field hold its unit and its origin: *regressed* on body mass and height, *measured* by others,
    or *chosen* here for want of a source; and its standard deviation from person to person.

    Regressed inertias of limbs have a standard error of 13 to 21 % (Yeadon and Morlock 1989), of
    the trunk less; masses by X-ray absorption differ from regressions by 3 to 10 % (Rossi 2013),
    more in obese persons. Stiffness and delay scatter as their sources do, below. The deviations
    of l1, c_h and tau_m are judgement: nobody has measured them.

    Attributes
    ----------
    m1 : float
        Mass of the lower body, kg. Regressed: de Leva 1996, pelvis and legs 50.89 % of the body,
        and 20 kg of seat (chosen).
    m2 : float
        Mass of the upper body, kg. Regressed: de Leva 1996, 49.11 % of the body.
    l1 : float
        Height of the centre of mass of the lower body above the pivot, m; below it if negative.
        Regressed, with a chosen layout of the seat.
    l2 : float
        Height of the centre of mass of the upper body above the lumbar joint, m. Regressed, with
        the arms folded (chosen).
    l12 : float
        Height of the lumbar joint above the pivot, m. Regressed, with a pivot 0.05 m below the
        surface of the seat (chosen).
    J1 : float
        Moment of inertia of the lower body about its centre of mass, frontal plane, kg m^2.
        Regressed, with a seat of 0.25 m radius of gyration (chosen).
    J2 : float
        Moment of inertia of the upper body about its centre of mass, frontal plane, kg m^2.
        Regressed.
    k_h : float
        Stiffness of the lumbar joint, Nm/rad. Measured: passive lateral bending, the data of
        Gombatto in the review PMC9293810, Table 3, 14 Nm/rad in the first quarter of the range
        and 36 to 43 in the second; a value in between.
    c_h : float
        Damping of the lumbar joint, Nms/rad. Chosen.
    k_r : float
        Stiffness that the robot gives the seat, Nm/rad. Chosen; the dissertation sets twice the
        critical stiffness of each subject.
    c_r : float
        Damping that the robot gives the seat, Nms/rad. Chosen.
    tau_d : float
        Delay from command to muscle, s. Chosen; 0.06 to 0.1 is plausible.
    tau_m : float
        Time constant of the muscle, s. Chosen.
    gravity : float
        Acceleration of gravity, m/s^2. Chosen: 9.81.

    Raises
    ------
    ValueError
        When a value is not a finite number in its range: lengths of the upper body, masses,
        inertias and times are positive, stiffness, damping and gravity are not negative.
    """

    m1: float = quantity(60.6, "kg", "regressed", "3 %", above=0.0)
    m2: float = quantity(39.1, "kg", "regressed", "4 %", above=0.0)
    l1: float = quantity(0.058, "m", "regressed", 0.015)
    l2: float = quantity(0.263, "m", "regressed", "5 %", above=0.0)
    l12: float = quantity(0.279, "m", "regressed", "5 %", above=0.0)
    J1: float = quantity(2.53, "kg m^2", "regressed", "12 %", above=0.0)
    J2: float = quantity(1.34, "kg m^2", "regressed", "12 %", above=0.0)
    k_h: float = quantity(30.0, "Nm/rad", "measured", "35 %", least=0.0)
    c_h: float = quantity(2.5, "Nms/rad", "chosen", "50 %", least=0.0)
    k_r: float = quantity(120.0, "Nm/rad", "chosen", "2 %", least=0.0)
    c_r: float = quantity(5.0, "Nms/rad", "chosen", "5 %", least=0.0)
    tau_d: float = quantity(0.08, "s", "chosen", 0.01, above=0.0)
    tau_m: float = quantity(0.06, "s", "chosen", "25 %", above=0.0)
    gravity: float = quantity(9.81, "m/s^2", "chosen", least=0.0)


@dataclass(frozen=True)
class SeatedBalanceLimits(Quantities):
    """What bounds the motion and the command, each symmetric about upright and rest.

    Attributes
    ----------
    theta1 : float
        Angle of the seat at its mechanical stops, rad. Measured: 12 degrees in the dissertation.
    theta2 : float
        Angle of the upper body, rad. Chosen: 15 degrees.
    theta1_rate, theta2_rate : float
        Angular velocities, rad/s. Chosen.
    command : float
        Lumbar torque, Nm. Chosen: about half of what a man can do sideways (McNeill 1980, low
        confidence). A perturbation of 5 Nm never reaches it: the saturating benchmark takes 6 Nm.

    Raises
    ------
    ValueError
        When a limit is not a positive finite number.
    """

    theta1: float = quantity(math.radians(12.0), "rad", "measured", above=0.0)
    theta2: float = quantity(math.radians(15.0), "rad", "chosen", above=0.0)
    theta1_rate: float = quantity(1.5, "rad/s", "chosen", above=0.0)
    theta2_rate: float = quantity(1.5, "rad/s", "chosen", above=0.0)
    command: float = quantity(70.0, "Nm", "chosen", above=0.0)
