"""Test of the model on carts with known errors; columns against finite differences."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import impc
from experiments.residual_study import diagnosed
from experiments.uncertain_body import cart
from impc.assess.lack_of_fit import DELAY, LEAN, LIMIT, LackOfFit, lack_of_fit
from impc.assess.printed_gain import gain_estimate
from impc.inverse.further_unknowns import with_errors_unknown
from impc.inverse.laws import GainLaw
from impc.inverse.unknowns import Unknowns
from impc.studies.fit.subject import fit_recordings
from tests.assess.cart_fits import uncertain_cart, uncertain_fit
from tests.support import posed, present, regulator


@functools.cache
def result_of(seed: int, error: str, root: float = 0.0) -> LackOfFit:
    found = present(lack_of_fit(gain_estimate(uncertain_fit(seed, error, root))))
    return found


@pytest.mark.parametrize(("seed", "root"), [(0, 0.0), (1, 0.0), (0, 0.9), (1, 0.9)])
def test_noise_of_the_recorder_gives_no_alarm(seed: int, root: float) -> None:
    """Body drawn from its stated uncertainty."""
    assert not result_of(seed, "none", root).alarm


@pytest.mark.parametrize(
    ("error", "names", "size"),
    [
        ("delay", (DELAY,), 1.0),
        ("limit", (LIMIT,), np.log(1.05)),
        ("lean", (LEAN, "offset.pos", "offset.vel"), None),
    ],
)
def test_an_error_is_named_with_its_size(
    error: str, names: tuple[str, ...], size: float | None
) -> None:
    """Seed 1: one sample of delay, 5 % of the limit, a constant push in each trial."""
    found = present(result_of(1, error).culprit)
    assert found.name in names
    if size is not None:
        assert abs(found.size - size) < 4 * found.deviation
        assert found.deviation < 0.2 * size


def test_what_is_named_is_fitted_too() -> None:
    """One sample of delay, seed 1: the second fit includes it and covers the gain."""
    problem, truth, _ = uncertain_cart(1, "delay")
    settings = impc.FitSettings(
        horizon=10, u_max=0.55, held_out=False, intent_draws=False, methods=[]
    )
    result = fit_recordings(problem, settings)
    assert [present(one).alarm for one in result.lack] == [True, False]
    (delay,) = (item for item in result.parameters if item.name == "extra_delay")
    assert abs(delay.value - 0.05) < 3 * delay.deviation
    ends = [(item.low, item.high) for item in result.gain_intervals[:2]]
    assert all(low <= value <= high for (low, high), value in zip(ends, truth[0], strict=True))


def test_what_is_fitted_or_absent_is_not_tested() -> None:
    person, K, _ = uncertain_cart()
    problem, S = person.with_body_fixed(), np.eye(1)
    offset = ("offset", problem.plant.outputs[0])
    with_offset, unlimited = with_errors_unknown(problem, [offset]), problem.without_bounds()
    for name, one, tested in (
        (".".join(offset), problem, True),
        (".".join(offset), with_offset, False),
        (LIMIT, problem, True),
        (LIMIT, unlimited, False),
    ):
        space = Unknowns(one, GainLaw(one, K, S))
        found = present(lack_of_fit(space.ended(space.start)))
        assert (name in [*found.untestable, *(item.name for item in found.errors)]) == tested


def test_trials_with_gaps_are_left_out() -> None:
    person, K, _ = uncertain_cart()
    problem, trial = person.with_body_fixed(), person.recordings[0]
    outputs = np.array(trial.outputs)
    outputs[20:30] = np.nan
    gapped = impc.replace(trial, outputs=outputs)

    def tested(recordings: tuple[impc.Recording, ...]) -> LackOfFit | None:
        one = impc.replace(problem, recordings=recordings)
        space = Unknowns(one, GainLaw(one, K, np.eye(1)))
        return lack_of_fit(space.ended(space.start))

    whole, with_it = (present(tested((*problem.recordings, *more))) for more in ((), (gapped,)))
    assert [one.name for one in with_it.errors] == [one.name for one in whole.errors]
    expected = [one.evidence for one in whole.errors]
    assert [one.evidence for one in with_it.errors] == pytest.approx(expected, rel=1e-9)
    assert tested((gapped,)) is None


def test_too_little_is_not_tested() -> None:
    """Exact fit, and a plant whose delay is already modelled."""
    law, push = regulator(cart(), np.diag([4.0, 1.0]), 1, 10), 0.2 * np.sin(np.arange(200) / 7)
    y = law.simulate([0, 0], disturbance=push).outputs[:-1]
    problem = posed(law, impc.Recording(law.plant, y, push))
    assert lack_of_fit(gain_estimate(impc.fit(problem))) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "alarms"),
    [("recorder", (0, 2)), ("coloured", (0, 2)), ("default", (9, 10)), ("motor", (9, 10))],
)
def test_ten_subjects_on_the_seat(name: str, alarms: tuple[int, int]) -> None:
    """Recording noise, nonlinear body, and motor noise at the limit: seeds 0 to 9."""
    found = [diagnosed(seed, name, order=1, horizon=4) for seed in range(10)]
    count = sum(item is not None and item.alarm for item in found)
    assert alarms[0] <= count <= alarms[1]
