"""Structures of target tracking on the recordings, where they are."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.cursor_data import data_file, read_conditions
from experiments.cursor_structures import STRUCTURES, structure_rows
from tests.experiments.recordings import recorded

pytestmark = pytest.mark.full


@pytest.mark.slow
@recorded
def test_the_error_alone_predicts_as_well_as_any_weights() -> None:
    """At 13 px; a minute."""
    rows = structure_rows(read_conditions(data_file())[1])
    assert [row.structure for row in rows] == ["any weights", *STRUCTURES]
    assert np.ptp([row.held_out for row in rows]) < 0.5
    assert not any(row.refused for row in rows)
    assert rows[2].velocity == 0.0
    assert rows[2].high < 0.2
