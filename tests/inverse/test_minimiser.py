"""Elimination of trial-specific unknowns gives the minimum of the full problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from impc.inverse.minimiser import End, Ended, Prior, Rows, Stop, minimise

TRIALS, ROWS, SHARED, OWN = 30, 9, 3, 2
COUNT = TRIALS * ROWS


@dataclass
class Curved:
    """r_i = sin(A_i u + B_i v_i) - c_i."""

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    bent: bool = False

    count = COUNT

    def residual(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(self.A @ u + np.einsum("twn,tn->tw", self.B, v)) - self.c)

    def rows(self, u: np.ndarray, v: np.ndarray) -> Rows:
        self.last = u, v
        slope = np.cos(self.A @ u + np.einsum("twn,tn->tw", self.B, v))[..., None]
        parts = self.residual(u, v), slope * self.A, slope * self.B
        return Rows.of_white_noise(self.count, *parts, curved=self.bent)

    def square(self, u: np.ndarray, v: np.ndarray) -> float:
        return float(np.sum(self.residual(u, v) ** 2))

    def value(self, u: np.ndarray, v: np.ndarray) -> float:
        return float(self.count * np.log(max(self.square(u, v), 1e-300)))

    def bend(self, du: np.ndarray, dv: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        u, v = self.last
        here = self.rows(u, v)
        change = self.residual(u + share * du, v + share * dv) - here.residual
        return (
            np.einsum("twa,tw->a", here.shared, change),
            np.einsum("twn,tw->tn", here.own, change),
        )


def problem(
    seed: int, *, exact: bool = False, bent: bool = False, weight: float = 0.0
) -> tuple[Curved, Prior]:
    """Noisy, or with zero residual near the start."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((TRIALS, ROWS, SHARED))
    B = rng.standard_normal((TRIALS, ROWS, OWN))
    u, v = rng.standard_normal(SHARED), rng.standard_normal((TRIALS, OWN))
    truth = u + 0.3 * rng.standard_normal(SHARED), v + 0.3 * rng.standard_normal(v.shape)
    c = np.sin(A @ truth[0] + np.einsum("twn,tn->tw", B, truth[1]))
    if not exact:
        c = c + 0.3 * rng.standard_normal(c.shape)
    return Curved(A, B, c, bent), Prior(u, v, np.full(SHARED, weight), weight)


def searched(model: Curved, prior: Prior, *stop: Any) -> End:
    return minimise(model, prior, (prior.u, prior.v), Stop(*stop))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("weight", [0.0, 5.0])
def test_the_minimum_is_that_of_another_search(seed: int, bent: bool, weight: float) -> None:
    """BFGS from the solution finds no lower value of N log |r|^2 plus prior."""
    model, prior = problem(seed, bent=bent, weight=weight)
    end = searched(model, prior, 1e-8, 0.0, 400)
    u, v = end.u, end.v
    assert end.ended is Ended.CONVERGED
    assert end.promised <= 1e-8

    def value(z: np.ndarray) -> float:
        u, v = z[:SHARED], z[SHARED:].reshape(TRIALS, OWN)
        return float(COUNT * np.log(model.square(u, v)) + prior.square(u, v))

    found = np.concatenate([u, v.ravel()])
    began = value(np.concatenate([prior.u, prior.v.ravel()]))
    best = scipy.optimize.minimize(value, found, method="BFGS")
    assert value(found) < began - 1
    assert value(found) <= best.fun + 1e-4


@pytest.mark.parametrize("bent", [False, True])
def test_an_exact_problem_ends_at_rounding(bent: bool) -> None:
    """Any prior loses its weight as the residual vanishes."""
    model, prior = problem(7, exact=True, bent=bent, weight=1.0)
    end = searched(model, prior, 1e-6, 1e-24, 100)
    assert model.square(end.u, end.v) <= 1e-20


def test_a_column_that_nothing_sees_stays() -> None:
    model, prior = problem(3)
    model.A[..., -1] = 0
    end = searched(model, prior, 1e-4, 0.0, 100)
    assert end.converged
    assert end.u[-1] == prior.u[-1]


def test_where_nothing_can_be_evaluated_the_start_is_returned() -> None:
    model, prior = problem(3)

    class Refuses(Curved):
        def rows(self, u: np.ndarray, v: np.ndarray) -> None:  # type: ignore[override]
            return None

    end = searched(Refuses(model.A, model.B, model.c), prior, 1e-8, 0.0, 100)
    np.testing.assert_array_equal(end.u, prior.u)
    np.testing.assert_array_equal(end.v, prior.v)
    assert end.evaluations == 1
    assert end.ended is Ended.INFEASIBLE


@dataclass
class Creased(Curved):
    """A crease in u_0 at c: both sides promise a decrease on the other one, and none has it."""

    def residual(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        away = u[0] - self.c.flat[0]
        return np.array([[1.0, 1.0 + abs(away)]])

    def rows(self, u: np.ndarray, v: np.ndarray) -> Rows:
        side = 1.0 if u[0] >= self.c.flat[0] else -1.0
        shared = np.zeros((1, 2, 1))
        shared[0, 1, 0] = side
        return Rows.of_white_noise(self.count, self.residual(u, v), shared, np.zeros((1, 2, 0)))


def test_an_end_at_a_crease_is_no_minimum() -> None:
    """Every undamped step promises more than it delivers: stuck, and it says how much."""
    nothing = np.zeros((1, 0))
    model = Creased(nothing, nothing, np.array([0.3]))
    model.count = 100
    prior = Prior(np.zeros(1), nothing, np.zeros(1), 0.0)
    end = minimise(model, prior, (np.array([1.0]), nothing), Stop(0.01, 0.0, 100))
    assert end.ended is Ended.STUCK
    assert end.promised > 1
    assert not end.converged
    assert end.u[0] == pytest.approx(0.3, abs=0.05)


def test_a_search_that_ran_out_says_what_is_left() -> None:
    model, prior = problem(3)
    end = searched(model, prior, 1e-8, 0.0, 2)
    assert end.ended is Ended.STOPPED
    assert end.promised > 1e-8


class ShortSteps:
    """Long steps are infeasible, and each short one gains the same little."""

    tries, level = 0, 1.0

    def rows(self, _u: np.ndarray, _v: np.ndarray) -> Rows:
        residual = np.full((1, 1), np.sqrt(self.level))
        return Rows.of_white_noise(1, residual, np.ones((1, 1, 1)), np.zeros((1, 1, 0)))

    def value(self, _u: np.ndarray, _v: np.ndarray) -> float:
        self.tries += 1
        if self.tries % 14:
            return np.inf
        self.level *= 1 - 1e-6
        return float(np.log(self.level))

    def bend(self, _du: np.ndarray, _dv: np.ndarray, _share: float) -> None:
        return None


def test_steps_too_short_to_predict_a_decrease_end_as_stuck() -> None:
    start = np.zeros(1), np.zeros((1, 0))
    end = minimise(ShortSteps(), Prior(*start, np.zeros(1), 0.0), start, Stop(1e-2, 0.0, 50))
    assert end.ended is Ended.STUCK
    assert end.promised == pytest.approx(1.0)
