"""Ends of the search that are no minimum; that it ends at minima is tested by fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from impc.inverse.minimiser import Ended, Prior, Rows, Stop, minimise

NOTHING = np.zeros((1, 0))


@dataclass
class Model:
    """A residual (2,) of one unknown, and its derivative."""

    residual: Callable[[float], list[float]]
    slope: Callable[[float], list[float]]

    def rows(self, u: np.ndarray, _: np.ndarray) -> Rows | None:
        parts = np.array([self.residual(u[0])]), np.reshape(self.slope(u[0]), (1, 2, 1))
        return Rows.of_white_noise(100, *parts, np.zeros((1, 2, 0)))

    def square(self, u: np.ndarray, _: np.ndarray) -> float:
        return float(np.sum(np.square(self.residual(u[0]))))

    def value(self, u: np.ndarray, v: np.ndarray) -> float:
        return float(100 * np.log(self.square(u, v)))

    def bend(self, du: np.ndarray, dv: np.ndarray, _: float) -> tuple[np.ndarray, np.ndarray]:
        return 0 * du, 0 * dv


ROOTS = Model(lambda u: [1.0, np.exp(u) - 2.0], lambda u: [0.0, np.exp(u)])
#: Both sides of the crease at u = 0.3 promise a decrease on the other one, and none has it.
CREASE = Model(lambda u: [1.0, 1.0 + abs(u - 0.3)], lambda u: [0.0, 1.0 if u >= 0.3 else -1.0])


@pytest.mark.parametrize(
    ("model", "evaluations", "ended", "promised", "u"),
    [
        (ROOTS, 100, Ended.CONVERGED, (0.0, 1e-8), np.log(2.0)),
        (ROOTS, 2, Ended.STOPPED, (1e-8, np.inf), None),
        (CREASE, 100, Ended.STUCK, (1.0, np.inf), 0.3),
    ],
)
def test_an_end_says_what_it_is_and_what_is_left(
    model: Model, evaluations: int, ended: Ended, promised: tuple[float, float], u: float | None
) -> None:
    prior = Prior(np.zeros(1), NOTHING, np.zeros(1), 0.0)
    end = minimise(model, prior, (np.array([2.0]), NOTHING), Stop(1e-8, 0.0, evaluations))
    assert end.ended is ended
    assert end.converged == (ended is Ended.CONVERGED)
    assert promised[0] <= end.promised <= promised[1]
    assert u is None or end.u[0] == pytest.approx(u, abs=0.05)


def test_where_nothing_can_be_evaluated_the_start_is_returned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Model, "rows", lambda *_: None)
    prior = Prior(np.zeros(1), NOTHING, np.zeros(1), 0.0)
    end = minimise(ROOTS, prior, (np.array([2.0]), NOTHING), Stop(1e-8, 0.0, 100))
    assert (end.ended, end.evaluations, end.u[0]) == (Ended.INFEASIBLE, 1, 2.0)
