"""Hundreds of trials: the page draws those that are explained least, and names how many."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from impc.studies.fit.figures import shown_trials


def of_trials(explained: list[float]) -> Any:
    return SimpleNamespace(trials=[SimpleNamespace(vaf=np.array([v, v])) for v in explained])


def test_few_trials_are_all_drawn() -> None:
    assert shown_trials(of_trials([90.0, 20.0, 50.0])) == [0, 1, 2]


def test_of_500_those_that_are_explained_least() -> None:
    explained = np.random.default_rng(0).uniform(0, 100, 500).tolist()
    shown = shown_trials(of_trials(explained))
    assert shown == sorted(shown)
    assert len(shown) == 24
    assert max(explained[index] for index in shown) == np.sort(explained)[23]
