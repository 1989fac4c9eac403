"""Columns with clocks of their own come to one clock, or both clocks are named."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from impc.arrays import Array
from impc.errors import DataError
from impc.files.draft import summary
from impc.files.formats import read_table
from impc.files.table import make_table
from tests.files.samples import csv_text, save_mat

EVEN: Array = 0.02 * np.arange(600.0)  # 50 samples per second
NAMES = {
    "structs": ("a.Time", "a.Data", "b.Time", "b.Data"),
    "columns": ("time", "tilt", "time_2", "push"),
    "alphabet": ("push_t", "push", "tilt_t", "tilt"),
    "units": ("X", "tilt", "X_2", "push"),
    "groups": ("one/t", "one/x", "two/t", "two/x"),
}
CLOCKS: dict[str, tuple[Array, Array]] = {
    "later": (EVEN, EVEN + 0.1),
    "between samples": (EVEN, EVEN + 0.107),
    "twice as fast": (EVEN, np.asarray(0.01 * np.arange(1150.0))),
    "steps 1 % apart": (EVEN, 1.01 * EVEN),
    "half the steps": (EVEN, EVEN / 2),
}


def wave(time: Array) -> Array:
    return np.asarray(3 * np.sin(4 * time))


def both(names: tuple[str, ...], first: Array, other: Array) -> dict[str, Array]:
    """Two series of the same wave, the shorter one padded as in a file of columns."""
    series = [first, wave(first), other, wave(other)]
    most = max(map(len, series))
    full = [np.pad(one, (0, most - len(one)), constant_values=np.nan) for one in series]
    return dict(zip(names, full if names[1] == "tilt" else series, strict=True))


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("clocks", CLOCKS.values(), ids=CLOCKS)
def test_series_come_to_the_fastest_clock(
    names: tuple[str, ...], clocks: tuple[Array, Array]
) -> None:
    table = make_table("trial", both(names, *clocks), {"X": "s", "X_2": "s"})
    time, other = table.columns[names[0]], table.columns[names[2]]
    np.testing.assert_array_equal(time, other)
    fastest = min(clocks, key=lambda clock: float(clock[1]))
    inside = (fastest >= max(one[0] for one in clocks)) & (
        fastest <= min(one[-1] for one in clocks)
    )
    assert abs(len(time) - inside.sum()) <= 1
    for name in (names[1], names[3]):
        np.testing.assert_allclose(table.columns[name], wave(time), atol=0.02)
    (note,) = table.notes
    assert f"{names[0]} (0 to 11.98 by 0.02)" in note
    assert f"{names[2]} (" in note


@pytest.mark.parametrize("kind", ["mat", "csv"])
def test_two_series_in_a_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"trial.{kind}"
    if kind == "mat":
        made = both(NAMES["structs"], EVEN, EVEN + 0.1)
        parts = {
            part: {"Time": made[f"{part}.Time"], "Data": made[f"{part}.Data"]} for part in "ab"
        }
        save_mat(path, parts)
    else:
        path.write_text(
            csv_text(both(NAMES["columns"], *CLOCKS["twice as fast"])).replace("nan", "")
        )
    table = read_table(path)
    (*_, tilt, time, push) = table.columns.values()
    np.testing.assert_allclose(tilt, wave(time), atol=0.02)
    np.testing.assert_allclose(push, wave(time), atol=0.02)
    assert table.notes[0].startswith("interpolated to ")


@pytest.mark.parametrize(
    "columns",
    [
        {"time": EVEN, "tilt": wave(EVEN), "push": wave(EVEN), "timestamp": EVEN + 1.7e9},
        {"Frame": EVEN * 50, "time": EVEN, "EMG time": EVEN + 5, "tilt": wave(EVEN)},
        {"time": EVEN, "tilt": wave(EVEN), "time_ms": EVEN, "push": wave(EVEN)},
        {"t": EVEN, "t_ms": 1000 * EVEN, "ticks_time": 32768 * EVEN, "tilt": wave(EVEN)},
        {"a.Time": EVEN, "a.Data": wave(EVEN), "b.Time": EVEN + 1e-5, "b.Data": wave(EVEN)},
    ],
)
def test_one_clock_in_other_words_changes_nothing(columns: dict[str, Array]) -> None:
    table = make_table("trial", columns)
    assert table.notes == ()
    assert all(np.array_equal(table.columns[name], values) for name, values in columns.items())


def test_clocks_without_a_common_span_are_named() -> None:
    """One in ms, or one that counts from 1970."""
    for other in (1000 * EVEN, EVEN + 1.7e9):
        said = re.escape("without a common span: a.Time (0 to 11.98 by 0.02), b.Time (")
        with pytest.raises(DataError, match=said):
            make_table("trial", both(NAMES["structs"], EVEN, other))


def test_events_do_not_cut_the_signals() -> None:
    events = {"c.Time": np.array([3.0, 4.0, 5.0]), "c.Data": np.array([1.0, 2.0, 1.0])}
    table = make_table("trial", both(NAMES["structs"], EVEN, EVEN + 0.1) | events)
    assert table.samples == 595
    assert list(table.skipped) == ["c.Time", "c.Data"]


def test_what_a_series_lacks_stays_missing() -> None:
    made = both(NAMES["structs"], EVEN, np.delete(EVEN + 0.1, slice(200, 260)))
    made["a.Data"][100] = np.nan
    table = make_table("trial", made)
    assert 59 <= np.isnan(table.columns["b.Data"]).sum() <= 61
    assert np.flatnonzero(np.isnan(table.columns["a.Data"])).tolist() == [95]


@pytest.mark.parametrize("drift", [0.002, -0.01])
def test_clocks_of_the_same_rows_that_run_apart(drift: float) -> None:
    columns = {"time": EVEN, "daq_time": 1000 * (1 + drift) * EVEN, "tilt": wave(EVEN)}
    said = f"trial: clocks 'time' and 'daq_time' run {abs(drift):.2%} apart"
    assert summary(make_table("trial", columns)).endswith(said)


def test_rows_missing_are_counted_without_a_configuration() -> None:
    lost = np.delete(EVEN, [3, 50, 51])
    table = make_table("trial", {"time": lost, "tilt": wave(lost)})
    said = "clock 'time': 3 rows missing, none for longer than"
    assert summary(table).endswith(f"{said} 0.06 s")
    assert summary(table, 0.1).endswith(f"{said} a model sample: interpolated")
    assert "has 2 gaps" in summary(table, 0.05)
