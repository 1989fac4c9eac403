"""Cohort with a structure: weights of each unit, groups compared by logarithms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import impc
from impc.files.plant_sources import plant_source
from impc.studies.cohort.comparison import compare_cohort
from impc.studies.cohort.results import cohort_tables
from impc.studies.cohort.study import Study, read_study
from impc.studies.cohort.tasks import Store, fit_unit, study_tasks
from tests.studies.cohort.carts import write_study
from tests.support import present

pytestmark = pytest.mark.full

STRUCTURE = '[fit.structure]\nQ = ["x[0]", "x[1]"]\n'


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Store]:
    """Six subjects; cost weight of the position 4 in group a and 8 in group b."""
    folder = tmp_path_factory.mktemp("structured")
    path = write_study(folder, 6)
    path.write_text(path.read_text() + STRUCTURE)
    study = read_study(path)
    source = plant_source("tests.studies.cohort.carts:cart_plant", {})
    tasks, failed = study_tasks(impc.replace(study, plant=source.name), source)
    assert failed == {}
    store = Store(folder / "out", {name: task.digest for name, task in tasks.items()})
    for name, task in tasks.items():
        store.cache.keep(f"{name}/fit", task.digest, fit_unit(task))
    return study, store


def test_prices_hold_the_truth_and_the_groups_differ(fitted: tuple[Study, Store]) -> None:
    units = cohort_tables(*fitted)["units"]
    cost_weight = units["log_cost_weight.x[0]"]
    truth = np.where(units["group"] == "a", np.log(4.0), np.log(8.0))
    low, high = units["log_cost_weight_low.x[0]"], units["log_cost_weight_high.x[0]"]
    # Subjects differ by 10 % and one interval in twenty misses: six of them, seed 0.
    assert np.sum((low - 0.2 < truth) & (truth < high + 0.2)) == len(units) == 6
    assert np.sum(units["structure_refused"]) <= 1
    study, store = fitted
    kept = present(store.fit(study.units[0].name))
    compared = [name for name, column in kept["shown"].items() if column["compared"]]
    assert compared[:2] == ["log_cost_weight.x[0]", "log_cost_weight.x[1]"]
    found = {
        item.question: item
        for item in compare_cohort(units, compared)
        if item.measure == "log_cost_weight.x[0]"
    }
    assert set(found) == {"group"}
    assert found["group"].low < np.log(2.0) < found["group"].high
    assert found["group"].p < 0.05
    assert cost_weight.notna().all()


def test_a_structure_that_loses_its_plant_names_why(tmp_path: Path) -> None:
    """No feature observes the marginal mode: the unit fails with the structure's reason."""
    path = write_study(tmp_path, 2)
    path.write_text(path.read_text() + '[fit.structure]\nQ = ["x[2]"]\n')
    study = read_study(path)
    source = plant_source("tests.studies.cohort.carts:cart_plant", {})
    tasks, _ = study_tasks(impc.replace(study, plant=source.name), source)
    with pytest.raises(impc.InputError, match="expected a name"):
        fit_unit(next(iter(tasks.values())))
