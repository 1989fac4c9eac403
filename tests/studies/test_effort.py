"""What takes hours, or more memory than there is, is said before it is begun."""

from __future__ import annotations

import tracemalloc
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest
from click.testing import CliRunner

import impc.studies.fit.subject
from impc.cli.consent import require_consent
from impc.cli.main import main
from impc.control.closed_loop import prepare_loop
from impc.control.constraint_rows import directions
from impc.control.controller import Controller
from impc.errors import InputError
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.recordings import Recording
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.studies.effort import Effort, fit_effort
from impc.studies.fit.settings import FitSettings
from tests.support import random_plant

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(("n", "m", "horizon"), [(2, 1, 300), (4, 2, 100), (8, 1, 150)])
def test_memory_is_told_to_its_order_of_magnitude(n: int, m: int, horizon: int) -> None:
    """Against what building the rows and their derivatives takes, as numpy's allocator counts."""
    plant = random_plant(np.random.default_rng(5), n, m, 0.95)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    trial = Recording(plant, np.ones((50, n)))
    problem = Problem(plant, bounds, horizon, (trial,), terminal_set=False)
    told = fit_effort(problem, FitSettings(horizon=horizon)).gigabytes * 1e9
    K = solve_lqr(plant, Weights(np.eye(n), np.eye(m))).K
    controller = Controller.from_gain(plant, K, bounds, horizon, terminal_set=False)
    tracemalloc.start()
    try:
        prepare_loop(controller, directions(controller, n * m + m * m + n))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 0.5 < told / peak < 2


def test_time_grows_with_what_is_asked() -> None:
    plant = random_plant(np.random.default_rng(5), 4, 1, 0.95)
    bounds = Bounds(plant, u_min=-1, u_max=1)
    trials = (Recording(plant, np.ones((3000, 4))),) * 3
    problem = Problem(plant, bounds, 20, trials, terminal_set=False)
    usual = fit_effort(problem, FitSettings(replicates=1000, profiles=["a"], horizons=[10])).seconds
    assert 60 < usual < 7200
    assert fit_effort(problem, FitSettings(replicates=10**6)).seconds > 7200


def test_consent(monkeypatch: pytest.MonkeyPatch) -> None:
    require_consent(Effort(60, 0.1), given=False)
    require_consent(Effort(1e9, 0.1), given=True)
    with pytest.raises(InputError, match=r"would take about 2\.78e\+05 hours.*or say --yes"):
        require_consent(Effort(1e9, 0.1), given=False)
    machine = psutil.virtual_memory().total / 1e9
    with pytest.raises(InputError, match="more than this machine has"):
        require_consent(Effort(60, machine + 1), given=True)


@pytest.mark.parametrize("setting", ["replicates = 1000000", "horizon = 5000"])
def test_a_request_for_hours_or_memory_ends_at_once(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is fitted, and nothing is written."""

    def unwanted(*_: object, **__: object) -> None:
        raise AssertionError("the request is refused before the work")

    monkeypatch.setattr(impc.studies.fit.subject, "fit_recordings", unwanted)
    push = np.repeat(np.random.default_rng(0).choice([-1.0, 0.0, 1.0], 60), 10)
    rows = [f"{k / 100},{np.sin(k / 10) / 50},{value}" for k, value in enumerate(push)]
    (tmp_path / "a.csv").write_text("\n".join(["t,e,p", *rows]) + "\n")
    signals = "\n".join(
        f'[signals.{name}]\ncolumn = "{column}"\nunit = "{unit}"'
        for name, column, unit in (
            ("theta1", "e", "rad"), ("theta2", "e", "rad"), ("perturbation", "p", "N*m"),
        )
    )  # fmt: skip
    config = tmp_path / "a.toml"
    config.write_text(f'[recording]\ntime = "t"\n{signals}\n[fit]\nu_max = 6.0\n{setting}\n')
    words = ["fit", str(tmp_path / "a.csv"), "--plant", "seated-balance", "--config", str(config)]
    done = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2, done.stderr
    assert done.stderr.startswith("impc: error: this request: would ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
