"""W2: simulation with exact Jacobian compared with a CasADi graph; its nonlinear body."""

from __future__ import annotations

from functools import partial

import numpy as np

from experiments.benchmarks.peers import casadi_loop
from experiments.benchmarks.table import Row, compare
from experiments.benchmarks.timing import side_by_side
from experiments.benchmarks.workloads import Workload, seat
from impc.control.closed_loop import simulate, simulate_and_differentiate
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.model.plant import Plant
from plants.seated_subject import seated_balance_for

__all__ = ["simulation_rows"]


def simulation_rows(runs: int) -> list[Row]:
    """Time and compare; the states and derivatives of all must agree to 1e-9."""
    work = seat()
    controller, drive = work.controller, work.drives[0]
    n = controller.plant.n
    along = directions(controller, n, K=np.eye(n)[None])
    loops = {name: casadi_loop(work, name) for name in ("daqp", "qpoases")}
    derivative = {name: loop.forward(n) for name, loop in loops.items()}
    seeds = np.eye(n).reshape(1, -1)
    run, exact = simulate_and_differentiate(controller, drive, along)
    for name, loop in loops.items():
        reached = loop(controller.K)
        np.testing.assert_allclose(reached.full().T, run.x[1:], atol=1e-9)
        by_graph = derivative[name](controller.K, reached, seeds).full()
        by_graph = by_graph.reshape(n, n, drive.steps).transpose(2, 0, 1)
        np.testing.assert_allclose(by_graph, exact.x[1:], atol=1e-9)
    timings = side_by_side(
        {
            "own simulation": lambda: simulate(controller, drive),
            "own Jacobian": lambda: simulate_and_differentiate(controller, drive, along),
            **{name: partial(loop, controller.K) for name, loop in loops.items()},
        },
        4 * runs,
    )
    states = {name: loop(controller.K) for name, loop in loops.items()}
    graphs = {
        name: partial(graph, controller.K, states[name], seeds)
        for name, graph in derivative.items()
    }
    own_run = partial(simulate_and_differentiate, controller, drive, along)
    slow = side_by_side({"own": own_run, **graphs}, max(3, runs // 2))
    what = "W2 simulation + exact Jacobian in K (ten directions)"
    own, qpoases = timings["own Jacobian"], "CasADi conic qpOASES, simulation only"
    return [
        compare(what, qpoases, own, timings["qpoases"], 0.35),
        compare(what, "CasADi conic DAQP, simulation only", own, timings["daqp"]),
        *(
            compare(what, f"CasADi's forward derivatives, {name}", slow["own"], slow[name], 1 / 60)
            for name in derivative
        ),
        compare("W2 simulation alone", qpoases, timings["own simulation"], timings["qpoases"]),
        _body_row(work, runs),
    ]


def _body_row(work: Workload, runs: int) -> Row:
    """Row of the nonlinear body against the linear plant, same weights and torque."""
    system = seated_balance_for()
    plant = Plant(system, ["command"], body=system.body)
    laws = [
        Controller(each, work.weights, work.controller.bounds, 20, terminal_set=False)
        for each in (plant, plant.linear())
    ]
    along = [directions(law, 2 * plant.n, K=np.eye(plant.n, 2 * plant.n)[None]) for law in laws]
    moved, linear = (
        partial(simulate_and_differentiate, law, work.drives[0], each)
        for law, each in zip(laws, along, strict=True)
    )
    timings = side_by_side({"body": moved, "linear": linear}, 4 * runs)
    what = "a seat's nonlinear body, simulation + exact Jacobian in twenty directions"
    return compare(what, "the linear plant", timings["body"], timings["linear"])
