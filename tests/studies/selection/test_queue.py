"""Work on workers gives what it gives here, is kept, and is not done twice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from impc.errors import DataError
from impc.files.sealed import Kept
from impc.studies.cohort.cluster import Cluster, connected
from impc.studies.selection.key_parameters import Refits, refit_subsets
from impc.studies.selection.model import Trial
from impc.studies.selection.model_source import model_source
from impc.studies.selection.queue import in_turn, on_workers

if TYPE_CHECKING:
    from pathlib import Path

SUBSETS = ((0, 1), (0, 1, 2))


def doses() -> tuple[Trial, ...]:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    dose = np.zeros((64, 1))
    dose[::16] = 400.0
    return (Trial(dose, source.model.simulate(np.array([1.2, 0.08, 25.0]), dose)),)


def test_workers_give_the_same_and_it_is_kept(tmp_path: Path) -> None:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    arguments = {"a": (doses(), SUBSETS), "b": (doses(), SUBSETS[1:])}
    here = in_turn(source.model)(refit_subsets, Refits, arguments)
    kept = Kept(tmp_path / "kept")
    with connected(Cluster(workers=1)) as workers:
        there = on_workers(workers, source, kept)(refit_subsets, Refits, arguments)
    # A client that has nothing: whatever is asked of it fails.
    nobody = cast("Any", None)
    again = on_workers(nobody, source, kept)(refit_subsets, Refits, arguments)
    for found in (there, again):
        assert list(found) == ["a", "b"]
        for name in here:
            for one, other in zip(here[name].fits, found[name].fits, strict=True):
                np.testing.assert_array_equal(one.theta, other.theta)
                assert (one.free, one.misfit) == (other.free, other.misfit)
    whole = {file: file.read_bytes() for file in kept.folder.iterdir()}
    for file in whole:
        file.write_bytes(whole[file][:40])
    with pytest.raises(AttributeError):
        on_workers(nobody, source, kept)(refit_subsets, Refits, arguments)
    kept.forget()
    assert set(kept.folder.iterdir()) == set(whole)  # damaged, they could be another's
    for file, content in whole.items():
        file.write_bytes(content)
    kept.forget()
    assert not kept.folder.exists()


def test_a_fault_on_a_worker_is_its_sentence(tmp_path: Path) -> None:
    source = model_source("tests.studies.selection.dosing:blood_model", {})
    with connected(Cluster(workers=1)) as workers:
        run = on_workers(workers, source, Kept(tmp_path))
        with pytest.raises(DataError, match="there are none"):
            run(refit_subsets, Refits, {"a": ((), SUBSETS)})
