"""What a run leaves behind: figures, page, result.json, and files whole or not at all."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from markupsafe import Markup

from impc.errors import OutputError
from impc.model.plant import Plant
from impc.model.riccati import solve_lqr
from impc.model.weights import Weights
from impc.reporting.document import (
    Details,
    Heading,
    Lines,
    Note,
    Report,
    Section,
    Terms,
    Verdict,
    json_bytes,
)
from impc.reporting.finding import Chart, Finding, Picture, Severity
from impc.reporting.provenance import Provenance
from impc.reporting.writer import require_writable, write_files
from impc.studies.example.cases import CASES, EXAMPLE, SETTINGS, CaseResult
from impc.studies.example.report import (
    example_data,
    example_report,
    methods_finding,
)


@pytest.fixture(scope="module")
def provenance() -> Provenance:
    return Provenance("plants:yalmip_example")


@pytest.fixture(scope="module")
def report(case_a: CaseResult, provenance: Provenance) -> Report:
    return example_report([case_a], provenance)


@pytest.fixture(scope="module")
def figures(report: Report) -> dict[str, bytes]:
    return dict(report.figures)


@pytest.fixture(scope="module")
def page(report: Report) -> str:
    return report.page()


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# The table


def test_the_table_has_the_truth_and_every_method_in_order(case_a: CaseResult) -> None:
    finding = methods_finding(case_a)
    assert finding.table is not None
    table = finding.table.set_index("method")
    assert list(table.index) == ["truth", *EXAMPLE]
    np.testing.assert_allclose(table.loc["truth", ["Q11", "Q12", "Q22"]].astype(float), [1, 0, 1])
    last = table.loc["inverse_mpc_reduced", ["Q11", "Q12", "Q22"]].astype(float)
    np.testing.assert_allclose(last, [1, 0, 1], atol=1e-9)
    kept = dict(table["kept"])
    assert (kept["inverse_lqr_lmi"], kept["feedback_gain"], kept["inverse_mpc"]) == (
        "infeasible", "no", "yes"
    )  # fmt: skip


# result.json


def test_result_json_holds_the_numbers_of_an_independent_computation(
    case_a: CaseResult, provenance: Provenance
) -> None:
    content = json.loads(json_bytes(example_data([case_a], provenance, SETTINGS)))
    case = content["cases"]["A"]
    assert tuple(case["x0"]) == CASES["A"]
    A, B = np.array(content["plant"]["A"]), np.array(content["plant"]["B"])
    x, u = np.array(case["truth"]["x"]), np.array(case["truth"]["u"])
    assert x.shape == (21, 2)
    assert u.shape == (20, 1)
    np.testing.assert_allclose(x[1:], x[:-1] @ A.T + u @ B.T, atol=1e-12)
    for name, method in case["methods"].items():
        if method.get("feasible") is False:
            assert not {"Q", "R", "K", "x", "state_misfit", "residual"} & set(method)
            continue
        run = np.array(method["x"])
        assert method["max_abs_u"] == pytest.approx(np.max(np.abs(method["u"])))
        if name != "truth":
            assert method["state_misfit"] == pytest.approx(np.linalg.norm(run - x), abs=1e-12)
            assert method["simulations"] >= 0
        if "Q" in method:
            check_weights(case_a.controller.plant, method)


def check_weights(plant: Plant, method: dict[str, Any]) -> None:
    Q, R = np.array(method["Q"]), np.array(method["R"])
    np.testing.assert_allclose(solve_lqr(plant, Weights(Q, R)).K, method["K"], atol=1e-8)
    if "residual" in method:
        distance = np.hypot(np.linalg.norm(Q - np.eye(2)), R[0, 0] - 1)
        assert method["residual"] == pytest.approx(distance, abs=1e-12)


# Figures


def test_every_figure_comes_as_png_and_pdf(figures: dict[str, bytes]) -> None:
    stems = ["figure-3.2", "figure-3.3", "figure-3.4", "terminal-set", "comparison"]
    assert sorted(figures) == sorted(f"{s}-case-A.{kind}" for s in stems for kind in ("png", "pdf"))
    for name, content in figures.items():
        assert content.startswith(b"\x89PNG" if name.endswith("png") else b"%PDF")


# The page


def without_script(page: str) -> str:
    """The page without its script, which is the one that its policy lets run."""
    found = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(found) == 1
    seal = base64.b64encode(hashlib.sha256(found[0].encode()).digest()).decode()
    assert f"style-src 'unsafe-inline'; script-src 'sha256-{seal}'\">" in page
    return page.replace(f"<script>{found[0]}</script>", "")


def test_the_page_needs_nothing_else(page: str) -> None:
    assert not re.search(
        r"https?:|fetch\(|import|XMLHttp|\beval|innerHTML", page.split("<script>")[1]
    )
    text = without_script(re.sub(r"data:image/png;base64,[^\"]*", "", page))
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import|url\(", text)
    assert all(source.startswith("data:image/png") for source in re.findall(r'src="([^"]*)', page))
    anchors = re.findall(r'href="#([^"]*)', page)
    assert anchors
    assert all(f'id="{anchor}"' in page for anchor in anchors)
    assert page.count("<img") == page.count('alt="') == 4


EVIL = '<script>alert("1")</script>&'


class Texts(HTMLParser):
    """The texts of a page as a browser reads them."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_data(self, data: str) -> None:
        self.found.append(data)


def every_block() -> Report:
    """Each kind of block, each of its texts hostile."""
    lines = (EVIL, Markup("<code>{}</code>").format(EVIL))
    blocks = (
        *lines,
        Lines(lines),
        Terms([(EVIL, lines)]),
        Finding(
            "numbers",
            pd.DataFrame([(EVIL, 0.1), ("=1+1", EVIL)], columns=["=a", "p_b"]),
            EVIL,
            [EVIL],
            severity=Severity.RED,
        ),
        Picture(EVIL, EVIL, EVIL),
        Chart(Picture(EVIL, EVIL, EVIL), {EVIL: f"</script>{EVIL}"}),
        Heading(EVIL),
        Note(EVIL, EVIL),
        Verdict(EVIL),
        Details(EVIL, (EVIL,)),
    )
    return Report(
        EVIL, EVIL, blocks, [Section(EVIL, blocks, contents="In short"), Section("2", ())],
        figures={f"{EVIL}.png": b"png"},
        data={"a": np.array([1.0, np.nan])},
    )  # fmt: skip


def test_every_block_is_escaped_and_there() -> None:
    page = without_script(every_block().page())
    holder = r'<script type="application/json" class="chart">(.*?)</script>'
    for chart in re.findall(holder, page):
        assert not re.search("[<>&']", chart)
        assert json.loads(chart) == {EVIL: f"</script>{EVIL}"}
    page, count = re.subn(holder, "", page)
    assert count == 2
    assert "<script" not in page
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in page
    heads = re.findall(r"<(h1|h2|h3|ul|dl|table|figure|nav)[ >]", page)
    both = ["ul", "dl", "table", "figure", "figure", "h3"]
    assert heads == ["h1", "nav", *both, "h2", *both, "h2"]
    shown = Texts()
    shown.feed(page)
    # Title, first heading and section; in each of two places: 2 paragraphs, 2 lines, 3 of the
    # terms, caption, head and 2 cells, captions of 2 figures, heading, 2 of the note, the verdict,
    # what is folded and its summary.
    assert sum(text.count(EVIL) for text in shown.found) == 3 + 2 * 19
    assert 'href="#in-short"' in page
    assert 'id="in-short"' in page


def test_the_page_ends_with_the_words_that_it_uses() -> None:
    """Each is linked where it stands first; words of a word are there too; Markup is left alone."""
    blocks = (
        "The VAF is 99 %, its VAF too.",
        Markup("<code>LQR</code>"),
        Lines(["Condition numbers: <kappa>"]),
    )
    folded = Section("One", blocks, contents="One", folded=True)
    page = Report("a", "A", (), [folded], words=[("theta1", "Tilt <of> a seat.")]).page()
    assert re.findall(r'<dt id="word-([a-z0-9-]+)">', page) == [
        "theta1", "condition-number", "cost-weight", "eigenvalue", "kappa", "lqr", "vaf", "weights"
    ]  # fmt: skip
    assert "Tilt &lt;of&gt; a seat." in page
    assert page.count('href="#word-vaf"') == 1
    assert '<a class="word" href="#word-condition-number">Condition numbers</a>' in page
    assert "<code>LQR</code>" in page
    assert '<details class="section"><summary><h2 id="one">One</h2></summary>' in page
    assert page.count("<details") == page.count("</details>") == 1
    assert '<a href="#words">Words</a>' in page


def test_a_report_is_its_files() -> None:
    files = every_block().files()
    assert list(files) == ["report.html", "result.json", "numbers.csv", "tables.xlsx",
                           f"{EVIL}.png"]  # fmt: skip
    found = json.loads(files["result.json"])
    assert list(found) == ["schema", *every_block().provenance.data(), "a", "findings"]
    assert found["a"] == [1.0, None]
    assert found["findings"]["numbers"] == {
        "severity": "red", "sentences": [EVIL], "table": {"=a": [EVIL, "=1+1"], "p_b": [0.1, EVIL]}
    }  # fmt: skip
    assert b"\n'=1+1," in files["numbers.csv"]


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
