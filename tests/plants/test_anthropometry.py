"""Parameters from mass and height: table of fractions, and default person."""

from __future__ import annotations

import pytest

from plants import SeatedBalanceParameters, from_anthropometry
from plants.anthropometry import DE_LEVA, Sex

PAIRED = ("upper arm", "forearm", "hand", "thigh", "shank", "foot")


@pytest.mark.parametrize("sex", ["male", "female"])
def test_fractions_make_one_body(sex: str) -> None:
    _, segments = DE_LEVA[sex]
    total = sum(s.mass * (2 if name in PAIRED else 1) for name, s in segments.items())
    assert total == pytest.approx(1.0, abs=2e-4)  # four printed digits
    for segment in segments.values():
        assert 0 < segment.centre < 1
        assert 0 < segment.along < 1
        assert 0 < segment.across < 1


def test_default_person_has_the_default_parameters() -> None:
    found = from_anthropometry(79.7, 1.66)
    expected = SeatedBalanceParameters()
    for name, digits in (("m1", 1), ("m2", 1), ("l1", 3), ("l2", 3), ("l12", 3), ("J1", 2)):
        assert round(getattr(found, name), digits) == getattr(expected, name), name
    assert round(found.J2, 2) == expected.J2
    # Parameters that do not depend on mass and height keep their defaults.
    for name in ("k_h", "c_h", "k_r", "c_r", "tau_d", "tau_m", "gravity"):
        assert getattr(found, name) == getattr(expected, name)


def test_scaling_with_mass_and_height() -> None:
    cases: list[tuple[float, float, Sex]] = [(52.0, 1.93, "male"), (117.0, 1.54, "female")]
    for mass, height, sex in cases:
        base = from_anthropometry(mass, height, sex)
        if sex == "male":  # the published fractions, and the seat
            assert (base.m2, base.m1) == pytest.approx((0.4911 * mass, 0.5089 * mass + 20.0))
        heavy = from_anthropometry(1.5 * mass, height, sex)
        tall = from_anthropometry(mass, 1.1 * height, sex)
        ratios = [heavy.J2 / base.J2, tall.J2 / base.J2]
        assert ratios == pytest.approx([1.5, 1.1**2])
        assert heavy.l2 == pytest.approx(base.l2)
        assert tall.l2 == pytest.approx(1.1 * base.l2)
        assert tall.m2 == base.m2
        assert tall.l12 > base.l12
