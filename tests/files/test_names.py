"""Names of signals, subjects and files are treated as text everywhere."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.text import Text

from impc.files.formats import encode_table
from impc.files.table import make_table
from impc.reporting.finding import csv_bytes
from impc.reporting.rendering import plain
from impc.reporting.style import new_figure, page_style, render

HOSTILE = (
    r"$\frac{x}$", "$x^$", "a$b", r"\$5$", "{", "<b>&", "=1+1", "\udcff", "a\x00b", "\u202egnp",
)  # fmt: skip


def test_no_name_is_mathematics_on_a_figure() -> None:
    """Each name as title, label, note, legend entry and tick, next to powers of ten."""
    with page_style():
        figure = new_figure(8, 6)
        left, right = figure.subplots(1, 2)
        for index, name in enumerate(HOSTILE):
            left.loglog([1, 1000], [1, 1e5], label=name)
            right.annotate(name, (0.5, index))
        left.legend()
        left.set_title(HOSTILE[0], loc="left")
        left.set_xlabel(f"{HOSTILE[1]} (s)")
        left.set_ylabel(f"{HOSTILE[0]} (-)")
        right.plot([0, 1])
        right.set_xlabel("name (-)")
        right.set_ylabel("name (-)")
        right.set_xticks(range(len(HOSTILE)), HOSTILE, rotation=35)
        right.set_yticks([0, 1])
        right.set_yticklabels(HOSTILE[:2])
        assert b"<svg" in render(figure, "svg")
        texts: list[Any] = figure.findobj(Text)
        drawn = [text.get_text() for text in texts]
        set_as = [text._preprocess_math(text.get_text()) for text in texts]
    shown = [said for said, mathematics in set_as if not mathematics]
    numbers = [text for text, (_, how) in zip(drawn, set_as, strict=True) if how]
    assert numbers
    assert all(text.startswith(r"$\mathdefault{") for text in numbers)
    for name in HOSTILE:
        read = name.encode("unicode_escape").decode() if not name.isprintable() else name
        assert sum(read.replace(r"\udcff", r"\xff") == said for said in shown) >= 3, name


def test_no_cell_of_a_table_is_a_formula_and_numbers_stay_numbers() -> None:
    texts = ["=1+1", "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "-0.5;=2", "-a"]
    plain_texts = ["a=b", "3.2 deg²"]
    rows = [[*texts, *plain_texts, -1.5, np.float64(0.1), 3, None, float("nan"), True]]
    written = csv_bytes(pd.DataFrame(rows, columns=["=head"] * len(rows[0])))
    heads, found = csv.reader(io.StringIO(written.decode()))
    assert set(heads) == {"'=head"}
    for text, cell in zip(texts, found, strict=False):
        assert cell.startswith("'")
        assert cell.replace("'", "") == text.replace("\t", r"\t").replace("'", "")
        assert not any(part.startswith("=") for part in cell.split(";"))
    assert found[len(texts) : len(texts) + len(plain_texts)] == plain_texts
    assert found[-6:] == ["-1.5", "0.1", "3", "", "", "yes"]
    # German Excel ends a cell at a semicolon, quoted or not.
    name = "a;=cmd|'/C calc'!A0;b"
    table = make_table("simulated", {name: np.zeros(2), "=1+1": np.zeros(2)})
    for content in (csv_bytes(pd.DataFrame(columns=[name])), encode_table(".csv", table)):
        divided = next(csv.reader([content.decode().splitlines()[0]], delimiter=";"))
        assert divided[:2] == ["a", "'=cmd|'/C calc'!A0"]
    assert b",'=1+1" in encode_table(".csv", table)
    assert csv_bytes(pd.DataFrame({"a": ["\udcff\n"]})) == rb"a" + b"\n" + rb"\xff\n" + b"\n"


def test_json_takes_names_that_are_not_utf_8() -> None:
    """Pages accept them too: tests/cli/test_fit.py has a file with such a name."""
    assert plain({"file": ["m\udcff"]}) == {"file": [r"m\udcff"]}
