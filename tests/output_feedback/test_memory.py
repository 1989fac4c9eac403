"""Checkpoints of output-feedback fits; test_subject.py has the others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impc.inverse.methods import fit
from impc.output_feedback.models import person_report
from impc.output_feedback.observer import Observer
from impc.output_feedback.page import PersonModel
from impc.studies.fit.memory import open_memory
from impc.studies.fit.settings import FitSettings
from tests.output_feedback.test_fit import cart, posed

pytestmark = pytest.mark.full


def test_persons_of_an_interrupted_fit_are_not_fitted_again(tmp_path: Path) -> None:
    person = Observer(cart(), ["x"], motor=0.15, sensory=0.02)
    problem, settings = posed(person, 0.01, 0.9), FitSettings(horizon=5, u_max=0.9)
    found, stopped = fit(problem), "sees every state, noise in the loop"

    def interrupt(name: str) -> None:
        if name == stopped:
            raise KeyboardInterrupt

    whole = person_report(found, person, np.zeros(0))
    memory = open_memory(tmp_path, problem, settings)
    with pytest.raises(KeyboardInterrupt):
        person_report(found, person, np.zeros(0), done=interrupt, remember=memory.part)
    again, computed = open_memory(tmp_path, problem, settings), []

    def counted(
        name: str,
        compute: Callable[[], PersonModel],
        encode: Callable[[PersonModel], Any],
        decode: Callable[[Any], PersonModel],
    ) -> PersonModel:
        def counting() -> PersonModel:
            computed.append(name)
            return compute()

        return again.part(name, counting, encode, decode)

    report = person_report(found, person, np.zeros(0), remember=counted)
    names = [model.name for model in whole.models]
    assert computed == names[names.index(stopped) + 1 :] != []
    np.testing.assert_array_equal(report.entries, whole.entries)
    np.testing.assert_array_equal(report.levels, whole.levels)
    for one, other in zip(report.models, whole.models, strict=True):
        assert one.fit is not None
        assert other.fit is not None
        assert one.fit.criterion == other.fit.criterion
