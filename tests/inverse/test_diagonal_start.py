"""The start of a fit: prices on the states whose regulator exists and can be simulated."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from impc.cli.main import main
from impc.cli.plant import find_plant
from impc.files.plant_sources import make_plant
from impc.files.reading import read_recordings
from impc.inverse.diagonal_start import diagonal_weights
from impc.inverse.residuals import misfit_or_reason
from impc.model.riccati import solve_lqr
from impc.studies.cohort.study import read_study
from impc.studies.fit.settings import fit_settings
from impc.studies.fit.subject import fit_problem


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
