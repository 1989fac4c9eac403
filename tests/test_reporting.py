"""Reports: figures, page, result.json, and atomic writing of files."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

import impc.reporting
from impc.errors import OutputError
from impc.levels import Level
from impc.reporting.document import (
    Block,
    Check,
    Checks,
    Copy,
    Fold,
    Lines,
    Quiet,
    Report,
    Section,
    Terms,
)
from impc.reporting.finding import Chart, Finding, Picture, table_of
from impc.reporting.provenance import Provenance
from impc.reporting.rendering import report_script_hashes
from impc.reporting.style import new_figure
from impc.reporting.verdict import Alert, Claim, Key, Verdict
from impc.reporting.writer import require_writable, write_files
from impc.studies.example.cases import CaseResult
from impc.studies.example.report import example_report


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# The page


def without_scripts(page: str) -> str:
    """Page without scripts; all scripts are allowed by its content security policy."""
    found = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    policy = re.findall(r"script-src ([^\"]*)", page)[0].split()
    seals = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in found]
    assert policy == [f"'sha256-{seal}'" for seal in seals]
    assert {*seals} == {*report_script_hashes()[: len(seals)]}
    for one in found:
        page = page.replace(f"<script>{one}</script>", "")
    return page


def test_the_page_needs_nothing_else(case_a: CaseResult) -> None:
    page = example_report([case_a], Provenance("plants:yalmip_example")).page()
    assert not re.search(
        r"https?:|fetch\(|XMLHttp|\beval|innerHTML", "".join(page.split("<script>")[1:])
    )
    text = re.sub(r'<script type="application/json">.*?</script>', "", without_scripts(page))
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import|src=", text)
    anchors = re.findall(r'href="#([^"]*)', page)
    assert anchors
    assert all(f'id="{anchor}"' in page for anchor in anchors)
    names = re.findall(r'\bid="([^"]*)"', text)
    assert len(names) == len(set(names))


def test_the_library_of_curves_is_the_one_that_was_looked_at() -> None:
    """uPlot 1.6.31 is unchanged and has its licence."""
    place = Path(impc.reporting.__file__).parent / "vendor"
    files = {path.name: path.read_bytes() for path in place.iterdir()}
    seals = {name: hashlib.sha256(one).hexdigest()[:16] for name, one in files.items()}
    assert seals == {
        "uPlot.iife.min.js": "2d27e8ad3d228164",
        "uPlot.min.css": "df630c6a8d6f8eea",
        "LICENSE-uPlot": "8f989229699b4fe2",
    }


EVIL = '<script>alert("1")</script>&'


class Texts(HTMLParser):
    """Texts of a page as parsed by a browser."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_data(self, data: str) -> None:
        self.found.append(data)


def hostile() -> Figure:
    figure = new_figure(6, 3)
    ax = figure.subplots()
    ax.set_axis_off()
    ax.set_title(f"{EVIL} $x^2$")
    return figure


def every_block() -> Report:
    """All kinds of blocks with hostile texts."""
    lines = (EVIL, Markup("<code>{}</code>").format(EVIL))
    alert = Alert(Level.AMBER, EVIL, EVIL, EVIL, (EVIL,))
    blocks: tuple[Block, ...] = (
        *lines,
        Lines(lines),
        Terms([(EVIL, EVIL)]),
        Finding(
            "numbers",
            pd.DataFrame([(EVIL, 0.1), ("=1+1", EVIL)], columns=["=a", "p_b"]),
            EVIL,
            [EVIL],
            level=Level.RED,
        ),
        Picture(EVIL, EVIL, EVIL),
        Chart(EVIL, {EVIL: f"</script>{EVIL}"}),
        Quiet(EVIL),
        Checks([Check(Level.GREEN, EVIL, EVIL)]),
        alert,
        Fold(EVIL, (EVIL,)),
    )
    return Report(
        EVIL,
        EVIL,
        Verdict(Level.AMBER, EVIL, EVIL, [alert], [Claim(EVIL, EVIL)], [Claim(EVIL)]),
        [Section(EVIL, blocks, contents="In short"), Section("2", ())],
        [EVIL],
        keys=[Key(EVIL, EVIL, EVIL, EVIL)],
        figures={EVIL: hostile},
        copy=Copy(EVIL, EVIL),
        data={"a": np.array([1.0, np.nan])},
    )


def test_every_block_is_escaped_and_there() -> None:
    page = without_scripts(every_block().page())
    holder = r'<script type="application/json">(.*?)</script>'
    (chart,) = re.findall(holder, page)
    assert not re.search("[<>&']", chart)
    assert json.loads(chart) == {EVIL: f"</script>{EVIL}"}
    page = re.sub(holder, "", page)
    assert "<script" not in page
    assert page.count("<h1") == 1
    shown = Texts()
    shown.feed(page)
    # Window, kind, meta, headline, sentence, 4 of the key, 3 claims, 2 to copy, section; twice 4 of
    # an alert; 2 paragraphs, 2 lines, 2 of a term, caption, sentence, 2 cells, caption of the
    # figure, its title and text, quiet, 2 of a check, 2 of a fold.
    assert sum(text.count(EVIL) for text in shown.found) == 15 + 8 + 2 + 2 + 2 + 4 + 1 + 2 + 1 + 4
    assert 'href="#in-short"' in page
    assert 'id="in-short"' in page


def test_a_drawing_follows_the_page_and_stands_alone() -> None:
    """Colours are variables on the page and values in the file; output is reproducible."""
    report = every_block()
    page, files = report.page(), report.files(pdf=True)
    svg = files[f"figures/{EVIL}.svg"].decode()
    assert "var(--ink)" in page
    assert "#1b2229" not in page.partition("<main")[2]
    assert "#1b2229" in svg
    assert "$x^2$" in svg  # no mathematics
    assert files[f"figures/{EVIL}.pdf"].startswith(b"%PDF")
    assert report.files()[f"figures/{EVIL}.svg"] == files[f"figures/{EVIL}.svg"]
    assert f"figures/{EVIL}.pdf" not in report.files()


def test_terms_are_explained_once() -> None:
    blocks = (
        "The VAF is 99 %, its VAF too: <b>.",
        Markup("<code>ICC</code>"),
        Lines(["Condition numbers: <kappa>"]),
    )
    verdict = Verdict(Level.NOTE, "A", "b")
    page = Report("a", "A", verdict, [Section("One", blocks)]).page()
    found = re.findall(r'<span class="term"[^>]*>([^<]*)<span class="tip"', page)
    assert found == ["VAF", "Condition numbers"]
    assert "<code>ICC</code>" in page
    assert 'class="badge' not in page.partition("<main")[2]  # a note has none


def test_a_report_is_its_files() -> None:
    files = every_block().files()
    written = ["numbers.csv", "results.mat", "tables.xlsx", f"figures/{EVIL}.svg"]
    assert list(files) == ["report.html", "result.json", *written]
    found = json.loads(files["result.json"])
    own = every_block().provenance.data()
    assert list(found) == ["schema", *own, "verdict", "a", "findings"]
    assert found["a"] == [1.0, None]
    assert found["verdict"]["level"] == "amber"
    assert found["verdict"]["may_report"] == [f"{EVIL} {EVIL}"]
    assert found["findings"]["numbers"] == {
        "level": "red", "sentences": [EVIL], "table": {"=a": [EVIL, "=1+1"], "p_b": [0.1, EVIL]}
    }  # fmt: skip
    assert b"\n'=1+1," in files["numbers.csv"]


def test_no_heading_of_the_workbook_is_there_twice() -> None:
    """Two columns may share a heading if the page shows one of them."""
    table = pd.DataFrame({"vaf": [1.0], "held_out_vaf": [2.0]})
    same = dict.fromkeys(table.columns, "VAF (%)")
    finding = Finding("methods", table, labels=same, hidden=("held_out_vaf",))
    verdict = Verdict(Level.NOTE, "A", "b")
    files = Report("a", "A", verdict, [Section("One", [finding])]).files()
    sheet = pd.read_excel(io.BytesIO(files["tables.xlsx"]), "methods", engine="openpyxl")
    assert list(sheet.columns) == ["VAF (%)", "held_out_vaf"]


def test_a_new_table_is_one_list_of_columns() -> None:
    """Page, CSV, workbook and result.json follow from it."""
    rows = table_of([("1", 0.25), ("2", np.nan)],
                    {"trial": lambda row: row[0], "peak_tilt": lambda row: row[1]})  # fmt: skip
    verdict = Verdict(Level.NOTE, "A", "b")
    files = Report("a", "A", verdict, [Section("One", [Finding("peaks", rows)])]).files()
    page = files["report.html"].decode()
    assert re.findall(r"<t[hd][^>]*>(?:<span>)?([^<]+)<", page.partition("<table")[2]) == [
        "Trial", "Peak tilt", "1", "0.2500", "2", "-"
    ]  # fmt: skip
    assert files["peaks.csv"] == b"trial,peak_tilt\n1,0.25\n2,\n"
    found = json.loads(files["result.json"])["findings"]["peaks"]["table"]
    assert found == {"trial": ["1", "2"], "peak_tilt": [0.25, None]}
    sheet = pd.read_excel(io.BytesIO(files["tables.xlsx"]), "peaks", engine="openpyxl")
    assert sheet.iloc[:, 1].tolist()[0] == 0.25


# Writing


def test_files_are_written_and_written_over(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "er"
    written = write_files(folder, {"a": b"1", "b": b"2"})
    assert written == (folder / "a", folder / "b")
    (folder / "mine").write_bytes(b"kept")
    write_files(folder, {"b": b"3"})
    assert snapshot(tmp_path) == {"deep/er/a": b"1", "deep/er/b": b"3", "deep/er/mine": b"kept"}
    assert os.listdir(tmp_path / "deep") == ["er"]


@pytest.mark.parametrize("below", [".", "below", "far/below"])
def test_a_file_in_the_way_is_told_before_and_after_the_work(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_bytes(b"mine")
    for attempt in (require_writable, lambda folder: write_files(folder, {"a": b"1"})):
        with pytest.raises(OutputError, match="is a file") as error:
            attempt(tmp_path / "file" / below)
        assert "\n" not in str(error.value)
    assert snapshot(tmp_path) == {"file": b"mine"}


def test_an_interruption_leaves_no_new_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_files(tmp_path / "new" / "folder", {"a": b"1"})
    assert os.listdir(tmp_path) == []
