"""Drafts as values, and changes of their text that leave everything else byte for byte."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

from impc.cli.plant import find_plant
from impc.errors import InputError
from impc.files.configuration import FILL_IN
from impc.files.draft import Draft, Guess, drafted
from impc.files.edited import edited
from impc.files.table import make_table
from tests.files.samples import pushed_seat

OWN = """# Labor Süd, nicht löschen
[recording]
time = 't'        # Uhr
subject = "Jürgen"

[signals."Sitz (°) v. 1"]   # oben
column = 'Winkel "x"'
unit = "deg"   # am Gerät abgelesen
"""
CHANGES: dict[tuple[str, ...], Any] = {
    ("recording", "rate"): 100.0,
    ("recording", "subject"): None,
    ("signals", 'Knöchel "links" a.b', "unit"): "deg",
    ("signals", "theta1", "limit"): 12,
    ("signals", "Sitz (°) v. 1", "sign"): -1,
    ("plant", "sex"): "female",
    ("plant", "uncertainty", "mass"): "3 %",
    ("fit", "free"): ["J1", "J2"],
    ("report", "angles"): "radians",
}


def drafts() -> list[Draft]:
    """Of two tables, with and without a plant."""
    columns = dict(zip(["Zeit", "Sitz", 'say "ä"', "a.b"], pushed_seat(100).values(), strict=True))
    tables = [
        make_table("Versuch 1.csv", columns, {"Sitz": "Grad", "a.b": "N*m"}),
        make_table("t.tdms", {"theta1": np.arange(9.0) ** 2}, {"theta1": "deg"}, 50.0),
    ]
    sources = (find_plant("seated-balance", {}), None)
    return [drafted(table, source) for table in tables for source in sources]


def test_a_draft_is_a_value() -> None:
    found, _, other, _ = drafts()
    ambiguous = "the file states 'Grad', which is ambiguous: write deg for degrees, gon otherwise"
    place = "A GUESS from its place: check it"
    assert found.signals["theta1"] == Guess("Sitz", place, FILL_IN, ambiguous)
    assert found.clock is not None
    assert (found.clock.column, found.clock.unit, found.clock.certain) == ("Zeit", "s", False)
    assert other.signals["theta1"].certain
    assert not other.signals["theta2"].certain
    for one in drafts():
        assert one.places == one.toml().count(f'= "{FILL_IN}"')
        assert one.guesses == one.toml().lower().count("# a guess")


@pytest.mark.parametrize("text", [*(one.toml() for one in drafts()), OWN, "\n"])
def test_a_value_is_set_and_removed_and_the_rest_stays(text: str) -> None:
    for path, value in CHANGES.items():
        made, before = edited(text, {path: value}), tomllib.loads(text)
        assert at(tomllib.loads(made), path) == value
        assert len(set(text.splitlines()) - set(made.splitlines())) <= 1
        parts = [path[:end] for end in range(1, len(path) + 1)]
        new = next((part for part in parts if at(before, part) is None), ())
        if new:
            assert edited(made, {new: None}) == text


def at(content: Any, path: tuple[str, ...]) -> Any:
    """Value of a TOML path; None if there is none."""
    return at(content.get(path[0], {}), path[1:]) if path[1:] else content.get(path[0])


def test_the_answer_replaces_what_a_draft_asked() -> None:
    text, signal = drafts()[0].toml(), ("signals", "theta1")
    made = edited(
        text, {(*signal, "unit"): "deg", (*signal, "column"): "Knie", ("fit", "u_max"): 6}
    )
    assert '[signals.theta1]\ncolumn = "Knie"\nunit = "deg"\n# limit = 12.0            #' in made
    assert "u_max = 6               # largest command of the subject: command in N m; wi" in made
    assert "there is no limit" not in edited(text, {("fit", "u_max"): None})
    # A guess that is right is confirmed, and the comments of the user stay.
    assert 'column = "Sitz"           # A GUESS' in text
    assert 'column = "Sitz"\n' in edited(text, {(*signal, "column"): "Sitz"})
    kept = edited(OWN, {("signals", "Sitz (°) v. 1", "unit"): "rad"})
    assert kept == OWN.replace('"deg"', '"rad"')


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("[a]\nb = ", "is not TOML"),
        (".".join(["a"] * 16_000) + " = 1", "nested too deep"),
        ("signals = 3", "signals: is not a table"),
    ],
)
def test_hostile_text_is_refused(text: str, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        edited(text, {("signals", "x"): 1})
