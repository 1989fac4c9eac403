"""The example that most tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings
from matplotlib.figure import Figure

from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.studies.example.cases import CaseResult, run_case
from plants import yalmip_example
from tests import support
from tests.labelled_axes import require_labels
from tests.support import SEARCH, leave_blank

# What a command says must not depend on how fast it was; tests of progress ask for it.
os.environ["IMPC_QUIET"] = "1"

# The same examples on every machine and no clock; `make search` draws new ones.
settings.register_profile(
    "impc", derandomize=SEARCH == 1, deadline=None, database=None, print_blob=True
)
settings.load_profile("impc")


@pytest.fixture(autouse=True, scope="session")
def figures_have_units() -> Iterator[None]:
    """Whatever figure a test writes has labels with units on its axes."""
    save = Figure.savefig

    def checked(figure: Figure, *given: Any, **settings: Any) -> None:
        require_labels(figure)
        save(figure, *given, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", checked)
        yield


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of figures with no picture: drawing takes most of some commands' time."""
    leave_blank(monkeypatch)


@pytest.fixture
def example_plant() -> Plant:
    """The example of section 3.4: unstable, two states, one input."""
    return support.example_plant()


@pytest.fixture
def example_bounds(example_plant: Plant) -> Bounds:
    """|u| <= 1."""
    return Bounds(example_plant, u_min=-1, u_max=1)


@pytest.fixture(scope="session")
def case_a() -> CaseResult:
    """Case A of the example, by every method."""
    return run_case(Plant(yalmip_example()), "A")
