"""Elimination of trial-specific unknowns gives the minimum of the full problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from impc.inverse.minimiser import End, Ended, Prior, Rows, Stop, minimise

TRIALS, ROWS, SHARED, OWN = 30, 9, 3, 2


@dataclass
class Model:
    """A residual (trials, w) of u and v, and its derivatives by both."""

    count: int
    residual: Callable[[np.ndarray, np.ndarray], np.ndarray]
    slopes: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    bent: bool = False

    def rows(self, u: np.ndarray, v: np.ndarray) -> Rows | None:
        self.last = u, v
        parts = self.residual(u, v), *self.slopes(u, v)
        return Rows.of_white_noise(self.count, *parts, curved=self.bent)

    def square(self, u: np.ndarray, v: np.ndarray) -> float:
        return float(np.sum(self.residual(u, v) ** 2))

    def value(self, u: np.ndarray, v: np.ndarray) -> float:
        return float(self.count * np.log(max(self.square(u, v), 1e-300)))

    def bend(self, du: np.ndarray, dv: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        (u, v), (shared, own) = self.last, self.slopes(*self.last)
        change = self.residual(u + share * du, v + share * dv) - self.residual(u, v)
        return np.einsum("twa,tw->a", shared, change), np.einsum("twn,tw->tn", own, change)


def problem(
    seed: int, *, exact: bool = False, bent: bool = False, weight: float = 0.0, seen: int = SHARED
) -> tuple[Model, Prior]:
    """r_i = sin(A_i u + B_i v_i) - c_i, noisy, or with zero residual near the start.

    Only the first `seen` entries of u have an effect.
    """
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((TRIALS, ROWS, SHARED))
    A[..., seen:] = 0
    B = rng.standard_normal((TRIALS, ROWS, OWN))
    u, v = rng.standard_normal(SHARED), rng.standard_normal((TRIALS, OWN))
    truth = u + 0.3 * rng.standard_normal(SHARED), v + 0.3 * rng.standard_normal(v.shape)

    def phase(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray(A @ u + np.einsum("twn,tn->tw", B, v))

    def slopes(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.cos(phase(u, v))[..., None]
        return slope * A, slope * B

    c = np.sin(phase(*truth)) + (0 if exact else 0.3 * rng.standard_normal((TRIALS, ROWS)))
    model = Model(TRIALS * ROWS, lambda u, v: np.sin(phase(u, v)) - c, slopes, bent)
    return model, Prior(u, v, np.full(SHARED, weight), weight)


def searched(model: Model, prior: Prior, *stop: Any) -> End:
    return minimise(model, prior, (prior.u, prior.v), Stop(*stop))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("weight", [0.0, 5.0])
def test_the_minimum_is_that_of_another_search(seed: int, bent: bool, weight: float) -> None:
    """BFGS from the solution finds no lower value of N log |r|^2 plus prior."""
    model, prior = problem(seed, bent=bent, weight=weight)
    end = searched(model, prior, 1e-8, 0.0, 400)
    assert end.ended is Ended.CONVERGED
    assert end.promised <= 1e-8

    def value(z: np.ndarray) -> float:
        u, v = z[:SHARED], z[SHARED:].reshape(TRIALS, OWN)
        return model.value(u, v) + prior.square(u, v)

    found = np.concatenate([end.u, end.v.ravel()])
    assert value(found) < value(np.concatenate([prior.u, prior.v.ravel()])) - 1
    assert value(found) <= scipy.optimize.minimize(value, found, method="BFGS").fun + 1e-4


@pytest.mark.parametrize("bent", [False, True])
def test_an_exact_problem_ends_at_rounding(bent: bool) -> None:
    """Any prior loses its weight as the residual vanishes."""
    model, prior = problem(7, exact=True, bent=bent, weight=1.0)
    end = searched(model, prior, 1e-6, 1e-24, 100)
    assert model.square(end.u, end.v) <= 1e-20


def test_a_column_that_nothing_sees_stays() -> None:
    model, prior = problem(3, seen=SHARED - 1)
    end = searched(model, prior, 1e-4, 0.0, 100)
    assert end.converged
    assert end.u[-1] == prior.u[-1]


def test_where_nothing_can_be_evaluated_the_start_is_returned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, prior = problem(3)
    monkeypatch.setattr(Model, "rows", lambda *_: None)
    end = searched(model, prior, 1e-8, 0.0, 100)
    np.testing.assert_array_equal(end.u, prior.u)
    np.testing.assert_array_equal(end.v, prior.v)
    assert end.evaluations == 1
    assert end.ended is Ended.INFEASIBLE


def test_an_end_at_a_crease_is_no_minimum() -> None:
    """Every undamped step promises more than it delivers: stuck, and it says how much.

    Both sides of the crease at u = 0.3 promise a decrease on the other one, and none has it.
    """
    nothing = np.zeros((1, 0))
    model = Model(
        100,
        lambda u, _: np.array([[1.0, 1.0 + abs(u[0] - 0.3)]]),
        lambda u, _: (np.array([[[0.0], [1.0 if u[0] >= 0.3 else -1.0]]]), np.zeros((1, 2, 0))),
    )
    prior = Prior(np.zeros(1), nothing, np.zeros(1), 0.0)
    end = minimise(model, prior, (np.array([1.0]), nothing), Stop(0.01, 0.0, 100))
    assert end.ended is Ended.STUCK
    assert end.promised > 1
    assert not end.converged
    assert end.u[0] == pytest.approx(0.3, abs=0.05)


def test_a_search_that_ran_out_says_what_is_left() -> None:
    end = searched(*problem(3), 1e-8, 0.0, 2)
    assert end.ended is Ended.STOPPED
    assert end.promised > 1e-8


def test_steps_too_short_to_predict_a_decrease_end_as_stuck(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Long steps are infeasible, and each short one gains the same little."""
    tries, level = 0, 1.0

    def value(*_: object) -> float:
        nonlocal tries, level
        tries += 1
        level *= 1 if tries % 14 else 1 - 1e-6
        return np.inf if tries % 14 else float(np.log(level))

    model = Model(
        1,
        lambda *_: np.full((1, 1), np.sqrt(level)),
        lambda *_: (np.ones((1, 1, 1)), np.zeros((1, 1, 0))),
    )
    monkeypatch.setattr(Model, "value", value)
    end = searched(model, Prior(np.zeros(1), np.zeros((1, 0)), np.zeros(1), 0.0), 1e-2, 0.0, 50)
    assert end.ended is Ended.STUCK
    assert end.promised == pytest.approx(1.0)
