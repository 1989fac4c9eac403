"""Parameters of the seated-balance plant from body mass, height and sex.

Segments: de Leva, J Biomech 29(9), 1996, Table 4: mass as a fraction of body mass, length at the
mean height of the sample, centre of mass and radii of gyration as fractions of the length. Trunk
and head follow the chain vertex, cervicale, xiphoid, navel, mid-hip. The fractions are from two
public transcriptions that agree, the lengths from one.

Assumptions
-----------
- Lengths of the segments scale with height; the layout of the seat does not, except heights and
  breadth of the arms.
- The lumbar joint is at the height of the navel: pelvis and legs move with the seat, the other
  segments are the upper body. The feet rest on a support that is fixed to the seat.
- Trunk, head and upper arms are upright, the forearms lie across the trunk in the frontal plane,
  the thighs and feet point forwards, the shanks hang. Each segment is a rod along its own axis.
- Left and right are symmetric; all centres of mass are above or below the pivot when upright.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from plants._checks import finite_number
from plants.seated_parameters import SeatedBalanceParameters

Sex = Literal["male", "female"]


class Segment(NamedTuple):
    """A body segment of de Leva 1996, Table 4.

    Attributes
    ----------
    mass : float
        Mass of one side as a fraction of body mass.
    length : float
        Length in m at the mean height of the sample.
    centre : float
        Distance of the centre of mass from the upper (or proximal) end as a fraction of length.
    across : float
        Sagittal radius of gyration as a fraction of length: about the anteroposterior axis for a
        segment in the frontal plane.
    along : float
        Longitudinal radius of gyration as a fraction of length: about the anteroposterior axis for
        a segment that points forwards.
    """

    mass: float
    length: float
    centre: float
    across: float
    along: float


#: Sex -> mean height of the sample in m, and segments by name.
DE_LEVA: dict[str, tuple[float, dict[str, Segment]]] = {
    "male": (
        1.741,
        {
            "head": Segment(0.0694, 0.2429, 0.5002, 0.303, 0.261),
            "upper trunk": Segment(0.1596, 0.2421, 0.5066, 0.505, 0.465),
            "middle trunk": Segment(0.1633, 0.2155, 0.4502, 0.482, 0.468),
            "lower trunk": Segment(0.1117, 0.1457, 0.6115, 0.615, 0.587),
            "upper arm": Segment(0.0271, 0.2817, 0.5772, 0.285, 0.158),
            "forearm": Segment(0.0162, 0.2689, 0.4574, 0.276, 0.121),
            "hand": Segment(0.0061, 0.0862, 0.7900, 0.628, 0.401),
            "thigh": Segment(0.1416, 0.4222, 0.4095, 0.329, 0.149),
            "shank": Segment(0.0433, 0.4340, 0.4459, 0.255, 0.103),
            "foot": Segment(0.0137, 0.2581, 0.4415, 0.257, 0.124),
        },
    ),
    "female": (
        1.735,
        {
            "head": Segment(0.0668, 0.2437, 0.4841, 0.271, 0.261),
            "upper trunk": Segment(0.1545, 0.2280, 0.5050, 0.466, 0.449),
            "middle trunk": Segment(0.1465, 0.2053, 0.4512, 0.433, 0.415),
            "lower trunk": Segment(0.1247, 0.1815, 0.4920, 0.433, 0.444),
            "upper arm": Segment(0.0255, 0.2751, 0.5754, 0.278, 0.148),
            "forearm": Segment(0.0138, 0.2643, 0.4559, 0.261, 0.094),
            "hand": Segment(0.0056, 0.0780, 0.7474, 0.531, 0.335),
            "thigh": Segment(0.1478, 0.3685, 0.3612, 0.369, 0.162),
            "shank": Segment(0.0481, 0.4323, 0.4416, 0.271, 0.093),
            "foot": Segment(0.0129, 0.2283, 0.4014, 0.299, 0.139),
        },
    ),
}


# Geometry of seat and posture, all assumed. The heights of the arms, the breadth of the shoulders,
# the depth of the foot and the seat's centre are chosen within a plausible range such that a man of
# 79.7 kg and 1.66 m has the default `SeatedBalanceParameters`.
# Seat: mass (kg), radius of gyration in the frontal plane, and centre of mass above the pivot, m.
_SEAT_MASS, _SEAT_RADIUS, _SEAT_CENTRE = 20.0, 0.25, -0.02
# Depth of the pivot below the surface of the seat, and height of the hip joints above it, m.
_PIVOT, _HIP = 0.05, 0.09
# Centres of mass of the upper arms and of the folded forearms and hands above the lumbar joint, and
# distance of the upper arms from the midline, m at the mean height of the sample.
_UPPER_ARM, _FOREARM, _SHOULDER = 0.25, 0.20, 0.20
# Distance of the legs from the midline, and of the foot's centre of mass below the ankle (lateral
# malleolus), m.
_LEG, _FOOT_DROP = 0.09, 0.03


class _Part(NamedTuple):
    """Rigid part: mass (kg), height and distance from the midline (m), radius of gyration (m)."""

    mass: float
    height: float
    lateral: float
    radius: float


def from_anthropometry(mass: float, height: float, sex: Sex = "male") -> SeatedBalanceParameters:
    """Estimate masses, lengths and inertias; the other parameters keep their defaults.

    Parameters
    ----------
    mass : float
        Body mass in kg, from 20 to 300.
    height : float
        Standing height in m, from 1 to 2.5; the fractions are for adults.
    sex : {"male", "female"}
        Sample of de Leva.

    Returns
    -------
    SeatedBalanceParameters
        Change other parameters by ``dataclasses.replace(result, k_r=...)``.

    Raises
    ------
    ValueError
        If an argument is out of range.

    Notes
    -----
    The module's docstring lists the assumptions.
    """
    mass = finite_number("mass", mass, "give it in kg", least=20.0, most=300.0)
    height = finite_number("height", height, "give it in m", least=1.0, most=2.5)
    if sex not in DE_LEVA:
        raise ValueError(f"sex: expected one of {list(DE_LEVA)}, got {sex!r:.60}; give one of them")
    mean_height, segments = DE_LEVA[sex]
    scale = height / mean_height
    sized = {
        name: each._replace(mass=each.mass * mass, length=each.length * scale)
        for name, each in segments.items()
    }
    hip = _PIVOT + _HIP
    m1, l1, J1 = _combine(_lower_body(sized, hip))
    m2, l2, J2 = _combine(_upper_body(sized, scale))
    l12 = hip + sized["lower trunk"].length
    return SeatedBalanceParameters(m1=m1, m2=m2, l1=l1, l2=l2, l12=l12, J1=J1, J2=J2)


def _lower_body(segments: dict[str, Segment], hip: float) -> list[_Part]:
    """Pelvis, legs and seat; heights relative to the pivot."""
    pelvis, thigh, shank, foot = (segments[s] for s in ("lower trunk", "thigh", "shank", "foot"))
    ankle = hip - shank.length
    knee_to_centre = shank.centre * shank.length
    return [
        _standing(pelvis, hip + (1 - pelvis.centre) * pelvis.length),
        _pointing_forwards(thigh, hip),
        _standing(shank, hip - knee_to_centre, _LEG, sides=2),
        _pointing_forwards(foot, ankle - _FOOT_DROP),
        _Part(_SEAT_MASS, _SEAT_CENTRE, 0.0, _SEAT_RADIUS),
    ]


def _upper_body(segments: dict[str, Segment], scale: float) -> list[_Part]:
    """Trunk above the navel, head and arms; heights relative to the lumbar joint."""
    parts = []
    end = 0.0
    for name in ("middle trunk", "upper trunk", "head"):
        segment = segments[name]
        parts.append(_standing(segment, end + (1 - segment.centre) * segment.length))
        end += segment.length
    forearm = _FOREARM * scale
    return [
        *parts,
        _standing(segments["upper arm"], _UPPER_ARM * scale, _SHOULDER * scale, sides=2),
        _standing(segments["forearm"], forearm, sides=2),
        _standing(segments["hand"], forearm, sides=2),
    ]


def _standing(segment: Segment, height: float, lateral: float = 0.0, sides: int = 1) -> _Part:
    """Segment in the frontal plane, upright or across."""
    return _Part(sides * segment.mass, height, lateral, segment.across * segment.length)


def _pointing_forwards(segment: Segment, height: float) -> _Part:
    """Pair of segments that point forwards."""
    return _Part(2 * segment.mass, height, _LEG, segment.along * segment.length)


def _combine(parts: list[_Part]) -> tuple[float, float, float]:
    """Total mass, height of the centre of mass, and moment of inertia about it."""
    mass = sum(part.mass for part in parts)
    centre = sum(part.mass * part.height for part in parts) / mass
    inertia = sum(
        part.mass * (part.radius**2 + part.lateral**2 + (part.height - centre) ** 2)
        for part in parts
    )
    return mass, centre, inertia
