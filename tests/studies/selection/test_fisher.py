"""Sensitivities, information, rank and subsets against differences, recursion and brute force."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import pytest

import impc
import impc.studies.selection.fisher
import plants
from experiments.reproduction.selection import kronecker_sensitivity
from experiments.selection_claims import exhaustive
from impc.studies.selection.estimation import estimate, free_indices, multi_start
from impc.studies.selection.fisher import (
    fisher_information,
    largest_subsets,
    subset_variances,
    unseen_scalings,
)
from impc.studies.selection.model import Trial, normalised, parametric_model, sensitivity
from tests.studies.selection.heads import NAMES_FIM, head_model, head_trials

SEED = 1
MODEL = head_model()
NOMINAL = np.array(MODEL.typical)
TRIALS = head_trials(MODEL, NOMINAL, 0.8226, SEED)
FOUND = fisher_information(MODEL, NOMINAL, TRIALS)


def test_sensitivities_against_differences_and_the_kronecker_recursion() -> None:
    """Central differences of 1e-4 in normalised units: 1e-6 of the largest; (A.3): 1e-8."""
    given = TRIALS[0].input
    _, exact = sensitivity(MODEL, NOMINAL, given)
    _, differences = sensitivity(impc.replace(MODEL, jacobian=None), NOMINAL, given)
    scale = np.max(np.abs(exact), axis=0) + 1e-6 * np.max(np.abs(exact))
    assert np.all(np.abs(differences - exact) <= 1e-6 * scale)
    matrices = plants.head_neck_matrices()
    recursion = kronecker_sensitivity(matrices, NOMINAL, 1 / 60, given) * MODEL.gain
    np.testing.assert_allclose(recursion, exact, atol=1e-8 * np.max(np.abs(exact)))


def test_information_is_its_sum() -> None:
    """(A.2) and (A.6), sample by sample."""
    total, squares, samples = np.zeros((12, 12)), 0.0, 0
    for trial in TRIALS:
        outputs, derivative = sensitivity(MODEL, NOMINAL, trial.input)
        squares += float(np.sum((trial.outputs - outputs) ** 2))
        samples += outputs.size
        for row in derivative[:, 0]:
            total += np.outer(row, row)
    np.testing.assert_allclose(FOUND.F, total / (squares / (samples - 12)), rtol=1e-9)


def test_rank_and_what_is_not_seen() -> None:
    """Rank eight; the common scaling of the five torque gains is reported as null direction."""
    assert FOUND.rank == 8
    gains = ("Kvis", "Kvcr", "Kccr", "B", "K")
    assert unseen_scalings(MODEL, FOUND) == (gains,)
    moved = NOMINAL.copy()
    moved[[MODEL.names.index(name) for name in gains]] *= 1.3
    before, after = (MODEL.simulate(theta, TRIALS[0].input) for theta in (NOMINAL, moved))
    assert 1 - np.sum((after - before) ** 2) / np.sum(before**2) > 0.9999999


@pytest.mark.parametrize("bound", [0.05, 0.25, 0.95])
def test_growing_sets_is_exhaustive_search(bound: float) -> None:
    assert largest_subsets([FOUND.F], bound) == exhaustive(np.asarray(FOUND.F), bound)


def test_variances_are_those_of_the_inverse() -> None:
    rng = np.random.default_rng(SEED)
    root = rng.standard_normal((30, 6))
    others = rng.standard_normal((30, 6))
    F, G = root.T @ root, others.T @ others
    subsets = list(itertools.combinations(range(6), 3))
    expected = [
        max(np.max(np.diag(np.linalg.inv(item[np.ix_(s, s)]))) for item in (F, G)) for s in subsets
    ]
    np.testing.assert_allclose(subset_variances([F, G], subsets), expected)
    singular = np.ones((3, 3))
    assert np.isinf(subset_variances([singular], [(0, 1)])[0])


def test_monotone_in_the_bound_and_many_parameters() -> None:
    """Twenty-six parameters with 67 million subsets."""
    rng = np.random.default_rng(SEED)
    root = rng.standard_normal((40, 26)) * np.geomspace(1, 1e-2, 26)
    sizes = [largest_subsets([root.T @ root], bound).size for bound in (0.1, 1.0, 3.0)]
    assert sizes == sorted(sizes)
    assert 2 <= sizes[0] < sizes[-1]


def test_estimates_find_the_truth() -> None:
    """Seed 1: five parameters inside four Cramér-Rao deviations, VAF as the noise leaves it."""
    free = free_indices(MODEL, NAMES_FIM)
    start = NOMINAL.copy()
    start[list(free)] *= 1.2
    found = estimate(MODEL, TRIALS, free, start)
    assert found.vaf[0] == pytest.approx(82.26, abs=1.0)
    part = np.asarray(FOUND.F)[np.ix_(free, free)]
    deviation = np.sqrt(np.diag(np.linalg.inv(part)))
    error = (normalised(MODEL, np.array(found.theta)) - normalised(MODEL, NOMINAL))[list(free)]
    assert np.all(np.abs(error) < 4 * deviation)
    several = multi_start(MODEL, TRIALS, free, 3, SEED)
    assert several[0].misfit == pytest.approx(found.misfit, rel=1e-6)


def test_any_function_is_a_model() -> None:
    """Exponential decay by a plain function: the information of its closed form."""
    time = np.linspace(0, 4, 50)[:, None]
    model = parametric_model(
        ["a", "k"], [0.1, 0.1], [5, 3], [2.0, 1.0], lambda p, t: p[0] * np.exp(-p[1] * t)
    )
    theta = np.array([2.0, 1.0])
    found = fisher_information(model, theta, [Trial(time, model.simulate(theta, time))], 0.01)
    decay = np.exp(-time[:, 0])
    J = np.column_stack([decay, -2 * time[:, 0] * decay]) * model.gain
    np.testing.assert_allclose(found.F, J.T @ J / 0.01, rtol=1e-5)


def test_models_are_checked() -> None:
    def one(p: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(u * p[0])

    for low, typical, said in ((0, 2, "is outside"), (1, 1, "low < high")):
        with pytest.raises(impc.InputError, match=said):
            parametric_model(["a"], [low], [1], [typical], one)
    with pytest.raises(impc.InputError, match="unknown name"):
        free_indices(MODEL, ["mass"])
    with pytest.raises(impc.DataError, match="the list is empty"):
        estimate(MODEL, [], (0,), NOMINAL)


def test_subsets_beyond_number_are_refused_and_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty identified parameters: about a million subsets of five, more of six."""
    monkeypatch.setattr(impc.studies.selection.fisher, "_MOST", 2000)
    tracemalloc.start()
    try:
        with pytest.raises(impc.InputError, match="more than 2000 subsets keep a variance of 2"):
            largest_subsets([np.eye(40)], 2.0)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    few = np.diag([1.0] * 4 + [0.1] * 36)
    assert largest_subsets([few], 2.0).subsets == ((0, 1, 2, 3),)
