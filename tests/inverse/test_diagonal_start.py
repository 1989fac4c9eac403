"""The start of a fit: prices on the states whose regulator exists and can be simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from experiments.coverage import cart, noisy_trial
from impc.checking import replace
from impc.cli.main import main
from impc.cli.plant import find_plant
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import Scenario, Simulation
from impc.files.plant_sources import make_plant
from impc.files.reading import read_recordings
from impc.inverse import residuals
from impc.inverse.diagonal_start import _ranked, bryson_regulators, diagonal_weights
from impc.inverse.residuals import misfit_or_reason, residual_only
from impc.model.riccati import solve_lqr
from impc.studies.cohort.study import read_study
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.fit.subject import fit_problem


def test_trials_that_no_longer_count_are_not_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two trials, one with all of the misfit: once above `most` the other is left out."""
    first, second = noisy_trial(3, 0.0), noisy_trial(4, 0.0)
    spoiled = replace(first, outputs=first.outputs + 1.0)
    settings = FitSettings(horizon=10, u_max=1.0)
    both = fit_problem(cart(), [spoiled, second], settings)
    alone = fit_problem(cart(), [spoiled], settings)
    alone = replace(alone, output_scale=both.output_scale)
    law = bryson_regulators(both)[5][1]
    whole = misfit_or_reason(both, law.K, law.S)[0]
    part = misfit_or_reason(alone, law.K, law.S)[0]
    assert part < whole
    assert misfit_or_reason(both, law.K, law.S, most=2 * part)[0] == whole
    seen: list[Scenario] = []

    def counted(controller: Controller, drive: Scenario) -> Simulation:
        seen.append(drive)
        return simulate(controller, drive)

    monkeypatch.setattr(residuals, "simulate", counted)
    np.testing.assert_allclose(misfit_or_reason(both, law.K, law.S, most=part / 2)[0], part)
    assert len(seen) == 1


def test_the_start_is_made_from_the_best_of_all_prices() -> None:
    """Whatever is left out on the way, the first is the one of least misfit over all trials."""
    settings = FitSettings(horizon=10, u_max=1.0)
    trials = [noisy_trial(seed, 0.05) for seed in (3, 4, 5)]
    problem = fit_problem(cart(), trials, settings)
    misfits = [
        np.linalg.norm(residual_only(problem, law.K, law.S))
        for _, law in bryson_regulators(problem)
    ]
    best = bryson_regulators(problem)[int(np.argmin(misfits))][0]
    np.testing.assert_array_equal(_ranked(problem)[0][0].R, best.R)


def test_the_start_has_a_regulator(tmp_path: Path) -> None:
    """A seat of ten seconds: Bryson's best rule has a regulator, prices on each state had none."""
    arguments = ["simulate", "cohort", "--subjects", "2", "--trials", "1", "--duration", "10"]
    made = CliRunner().invoke(main, [*arguments, "--replicates", "0", "--out", str(tmp_path)])
    assert made.exit_code == 0, made.stderr
    study = read_study(tmp_path / "study.toml")
    unit, configuration = study.units[0], study.configuration
    person = {key: unit.person[key] for key in ("mass", "height", "sex")}
    source = find_plant(study.plant, {**configuration.plant, **person})
    plant = make_plant(source, tuple(configuration.signals))
    recordings = read_recordings(list(unit.files), configuration, plant)
    problem = fit_problem(plant, recordings, fit_settings(configuration.fit))
    solution = solve_lqr(plant, diagonal_weights(problem))
    size, reason = misfit_or_reason(problem, solution.K, solution.S)
    assert not reason
    assert size < 0.5 * sum(trial.outputs.size for trial in recordings) ** 0.5
