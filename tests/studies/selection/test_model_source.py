"""Results of workers equal local results, are stored, and are not computed twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import impc
from impc.studies.cache import Cache
from impc.studies.pool import Result
from impc.studies.scheduler import Cluster, connected
from impc.studies.selection.analysis import refit_subsets
from impc.studies.selection.estimation import Estimate
from impc.studies.selection.model import Trial
from impc.studies.selection.model_source import model_source, on_pool
from tests.studies.selection.dosing import in_turn
from tests.support import ThisProcess

SUBSETS = ((0, 1), (0, 1, 2))
FITS = tuple[Estimate, ...]


def doses() -> tuple[Trial, ...]:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    dose = np.zeros((64, 1))
    dose[::16] = 400.0
    return (Trial(dose, source.model.simulate(np.array([1.2, 0.08, 25.0]), dose)),)


def test_workers_give_the_same_and_it_is_kept(tmp_path: Path) -> None:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    arguments = {"a": (doses(), SUBSETS), "b": (doses(), SUBSETS[1:])}
    here = in_turn(source.model)(refit_subsets, FITS, arguments)
    cache, found = Cache(tmp_path / "kept"), list[bool]()
    with connected(Cluster(workers=1)) as pool:
        there = on_pool(pool, source, cache)(refit_subsets, FITS, arguments)

    def done(result: Result) -> None:
        found.append(result.found)

    again = on_pool(ThisProcess(), source, cache, done)(refit_subsets, FITS, arguments)
    assert found == [True, True]
    for other in (there, again):
        assert list(other) == ["a", "b"]
        for name in here:
            for one, two in zip(here[name], other[name], strict=True):
                np.testing.assert_array_equal(one.theta, two.theta)
                assert (one.free, one.misfit) == (two.free, two.misfit)
    for file in cache.folder.iterdir():
        file.write_bytes(file.read_bytes()[:40])
    on_pool(ThisProcess(), source, cache, done)(refit_subsets, FITS, arguments)
    assert found[2:] == [False, False]


def test_a_fault_on_a_worker_is_its_sentence_and_whose_it_is(tmp_path: Path) -> None:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    run = on_pool(ThisProcess(), source, Cache(tmp_path))
    with pytest.raises(impc.DataError, match=r"^a: .*the list is empty"):
        run(refit_subsets, FITS, {"a": ((), SUBSETS)})
