"""Sets of equivalent weights: equal trajectories, ranges attained and never exceeded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import impc
from experiments.benchmarks.workloads import Workload, chain_of_masses, example, seat
from impc.arrays import Array
from impc.assess.bounded_weights import (
    WeightsSet,
    entry_ranges,
    linear_ranges,
    weights_set,
)
from impc.assess.weights_ranges import pair_statements
from impc.control.closed_loop import simulate
from impc.inverse.solution_set import split_blocks
from impc.model.weights import condition_number

SEED = 2


def set_of(work: Workload, ratio: float = 10.0) -> WeightsSet:
    return weights_set(impc.gain_fibre(work.problem.plant, work.controller.K), ratio)


def random_members(found: WeightsSet, count: int) -> list[Array]:
    """Points along random rays from the least-condition member to the edge of the set."""
    rng, m = np.random.default_rng(SEED), found.fibre.plant.m
    centre = found.least.weights.block
    centre = centre * (m / np.trace(centre[-m:, -m:]))
    members = []
    for _ in range(count):
        ray = np.tensordot(rng.standard_normal(len(found.level)), found.level, 1)
        low, high = 0.0, 1.0
        while _inside(found, centre + high * ray) and high < 1e12:
            high *= 2
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if _inside(found, centre + middle * ray) else (low, middle)
        members += [centre + low * ray, centre + rng.uniform() * low * ray]
    return members


def _inside(found: WeightsSet, X: Array) -> bool:
    values = np.linalg.eigvalsh(X)
    return bool(values[0] > 0 and values[-1] <= found.limit * values[0])


@pytest.mark.parametrize("make", [example, lambda: seat(1, 10.0)], ids=["example", "seat"])
def test_members_give_the_same_trajectories(make: Callable[[], Workload]) -> None:
    """Sampled weights, rebuilt as controllers with bounds, give equal trajectories to 1e-9."""
    work = make()
    plant, law = work.problem.plant, work.controller
    truth = simulate(law, work.drives[0]).x @ plant.C.T
    size, kept = max(1.0, float(np.max(np.abs(truth)))), law.terminal is not None
    for X in random_members(set_of(work), 5):
        weights = split_blocks(X, plant.n)
        same = impc.Controller(plant, weights, law.bounds, law.horizon, terminal_set=kept)
        run = simulate(same, work.drives[0])
        np.testing.assert_allclose(run.x @ plant.C.T, truth, atol=1e-9 * size)


def test_ranges_are_those_of_random_search_with_two_states() -> None:
    """Ranges never exceeded, and attained to 1 % of their width, by 4000 random rays."""
    found = set_of(example())
    sampled = np.array(random_members(found, 4000))
    for (i, j), ends in entry_ranges(found).items():
        width = ends.high - ends.low
        assert np.min(sampled[:, i, j]) >= ends.low - 1e-9 * width
        assert np.max(sampled[:, i, j]) <= ends.high + 1e-9 * width
        assert np.min(sampled[:, i, j]) <= ends.low + 0.01 * width
        assert np.max(sampled[:, i, j]) >= ends.high - 0.01 * width


def test_ranges_of_several_inputs_are_never_passed() -> None:
    """Ten states, as in the seat workloads; the end points are members."""
    work = chain_of_masses(6, 100)
    found = set_of(work)
    sampled = np.array(random_members(found, 100))
    pairs = ((0, 0), (2, 1), (5, 5))
    directions = np.zeros((len(pairs), *found.first.shape))
    for direction, (i, j) in zip(directions, pairs, strict=True):
        direction[[i, j], [j, i]] += 0.5 if i != j else 1.0
    for (i, j), ends in zip(pairs, linear_ranges(found, directions), strict=True):
        width = ends.high - ends.low
        assert np.min(sampled[:, i, j]) >= ends.low - 1e-7 * width
        assert np.max(sampled[:, i, j]) <= ends.high + 1e-7 * width
        assert abs(ends.low - ends.least.bound) <= 1e-5 * width
        assert abs(ends.high - ends.most.bound) <= 1e-5 * width
        for weights in (ends.least.weights, ends.most.weights):
            assert condition_number(weights) <= found.limit * (1 + 1e-4)
            K = impc.solve_lqr(work.problem.plant, impc.Weights(weights.Q, weights.R)).K
            np.testing.assert_allclose(K, work.controller.K, atol=1e-6 * np.max(np.abs(K)))


def test_statements_agree_with_sampled_members() -> None:
    found = set_of(example(), 1.5)
    sizes, names = np.array([1.0, 3.0]), found.fibre.plant.states
    sampled = random_members(found, 300)
    statements = pair_statements(found, sizes, names)
    order, sense = [X[0, 0] - 9 * X[1, 1] for X in sampled], [X[0, 1] for X in sampled]
    for statement, values in zip(statements, (order, sense), strict=True):
        signs = {bool(value > 0) for value in values}
        if statement.holds is None:
            assert signs == {True, False}
        else:
            assert signs == {statement.holds}
    assert statements[0].holds is False


def test_a_ratio_must_leave_room() -> None:
    with pytest.raises(impc.InputError, match="ratio"):
        set_of(example(), 1.0)
