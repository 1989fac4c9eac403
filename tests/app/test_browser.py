"""In a real browser: drop files, answer, fit, stop, go on, read and compare."""

from __future__ import annotations

import base64
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import ConsoleMessage, Page

import impc
from tests.app.serving import PATIENCE, ROOT, german, serving, sheet
from tests.files.samples import workbook

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome") or ""
pytestmark = pytest.mark.skipif(
    not CHROMIUM or importlib.util.find_spec("playwright") is None,
    reason="needs chromium and the package playwright",
)
RULES = ["wcag2a", "wcag2aa", "wcag21aa", "wcag22aa", "best-practice"]
DROP = """files => { const all = new DataTransfer(), bytes = c => c.charCodeAt(0);
for (const f of files) all.items.add(new File([Uint8Array.from(atob(f.text), bytes)], f.name));
return all; }"""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    (folder / "VP07").mkdir()
    return folder


@pytest.fixture(scope="module")
def page(study: Path) -> Iterator[Page]:
    """The opened application; messages of its console are faults."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  # optional

    faults: list[str] = []
    with serving(study) as client, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        context = browser.new_context(viewport={"width": 1500, "height": 950})
        name, value = client.cookie.split("=", 1)
        place = {"domain": "127.0.0.1", "path": f"{client.base}/", "httpOnly": True}
        context.add_cookies([{"name": name, "value": value, "sameSite": "Strict", **place}])  # type: ignore[typeddict-item]
        context.set_default_timeout(1000 * PATIENCE)
        found = context.new_page()
        # Refusals are meant: of a file that is no recording, and of what a hostile report tries.
        meant = re.compile("Content Security Policy|415|sandboxed")

        def heard(one: ConsoleMessage) -> None:
            if one.type == "error" and not meant.search(one.text):
                faults.append(one.text)

        found.on("console", heard)
        found.on("pageerror", lambda one: faults.append(str(one)))
        found.goto(f"http://{client.host}{client.base}/")
        yield found
        browser.close()
    assert faults == []


def accessible(page: Page) -> None:
    """axe finds nothing at both widths, in both colour schemes; nothing is wider than the phone."""
    spec = importlib.util.find_spec("axe_playwright_python")
    assert spec is not None
    assert spec.origin is not None
    axe = Path(spec.origin).with_name("axe.min.js").read_text(encoding="utf-8")
    for width, scheme in ((1500, "light"), (1500, "dark"), (400, "light")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        page.evaluate(axe)
        found: dict[str, Any] = page.evaluate(
            f"axe.run(document, {{iframes: false, runOnly: {RULES}}})"
        )
        assert [(one["id"], one["nodes"][0]["html"]) for one in found["violations"]] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1500, "height": 900})


def reached(page: Page, wanted: str) -> None:
    """Press Tab until an element has the focus; its id or its text is `wanted`."""
    for _ in range(100):
        page.keyboard.press("Tab")
        where = "[document.activeElement.id, document.activeElement.textContent.trim()]"
        if wanted in page.evaluate(where):
            return
    raise AssertionError(wanted)


def typed(page: Page, place: str, keys: str) -> None:
    """Reach a field by Tab, type, and wait until it is saved; the focus stays in the page."""
    page.evaluate("document.activeElement.blur()")
    reached(page, place)
    with page.expect_response(lambda one: one.request.method == "POST"):
        page.keyboard.type(keys)
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.tagName") != "BODY"


def followed(page: Page, link: str) -> None:
    """Reach a link by Tab, and follow it."""
    reached(page, link)
    with page.expect_navigation():
        page.keyboard.press("Enter")


def drag(page: Page, place: str, share: float) -> float:
    """Drag a handle to a share of the plot's width; the saved time in s."""
    handle, plot = (page.locator(one).first.bounding_box() for one in (place, ".u-over"))
    assert handle is not None
    assert plot is not None
    page.mouse.move(handle["x"] + handle["width"] / 2, handle["y"] + 9)
    page.mouse.down()
    page.mouse.move(plot["x"] + share * plot["width"], handle["y"] + 9, steps=4)
    with page.expect_response(lambda one: one.request.method == "POST"):
        page.mouse.up()
    return float(page.input_value("#start"))


def test_every_screen_from_dropped_files_to_the_report(
    page: Page, study: Path, tmp_path: Path
) -> None:
    accessible(page)
    page.get_by_role("link", name="VP07").click()
    for seed in (1, 2):
        german(tmp_path / f"Versuch {seed}.csv", seed)
    table = impc.read_table(tmp_path / "Versuch 2.csv")
    workbook(tmp_path / "Versuch 2.xlsx", Versuch=sheet(table))
    (tmp_path / "Versuch 2.csv").unlink()
    (tmp_path / "notes.docx").write_text("no recording")
    files = [{"name": one.name, "text": base64.b64encode(one.read_bytes()).decode()}
             for one in sorted(tmp_path.iterdir()) if one.is_file()]  # fmt: skip
    page.dispatch_event("#drop", "drop", {"dataTransfer": page.evaluate_handle(DROP, files)})
    page.locator("#use2").wait_for()  # its row; the name alone is also in what is being copied
    assert "notes.docx" in page.inner_text("#said")
    accessible(page)
    page.get_by_role("link", name="Next: what each signal means").click()
    page.wait_for_selector(".uplot")
    accessible(page)
    cut = drag(page, ".cut.start", 0.25)
    assert cut == pytest.approx(1.5, abs=0.1)
    assert tomllib.loads((study / "VP07/subject.toml").read_text())["recording"]["start"] == cut
    # From here on by keyboard alone.
    for place, value in (("unit1", "deg"), ("unit2", "deg"), ("subject", "VP07")):
        typed(page, place, value)
    for index in (1, 2, 3):
        if page.locator(f"#sure{index}").count():
            typed(page, f"sure{index}", " ")
    page.wait_for_selector("aside h2:has-text('Ready')")
    followed(page, "Next: body and limit")
    accessible(page)
    for place, value in (("p_mass", "79,7"), ("p_height", "1,66"), ("u_max", "6")):
        typed(page, place, value)
    followed(page, "Next: fit")
    accessible(page)
    page.locator("button:enabled:has-text('Fit')").wait_for()  # it is checked first


@pytest.mark.full
def test_practice_is_fitted_stopped_gone_on_read_and_compared(page: Page, study: Path) -> None:
    page.goto("/".join(page.url.split("/")[:4]) + "/")  # the start, whatever was open before
    with page.expect_navigation():
        page.get_by_role("button", name="Practise").click()
    page.get_by_role("link", name="Fit", exact=True).click()
    page.get_by_role("button", name="Fit", exact=True).click()
    page.locator(".stages li").nth(1).wait_for()
    accessible(page)
    page.get_by_role("button", name="Stop").click()
    page.wait_for_selector("text=Stopped")
    page.get_by_role("button", name="Go on").click()
    page.wait_for_selector("text=Read the report")
    accessible(page)
    page.get_by_role("link", name="Read the report").click()
    report = page.frame_locator("iframe")
    report.locator("h1").wait_for()
    assert "6\xa0N\xa0m" in report.locator("h1").inner_text()
    accessible(page)
    hostile(page, study / "practice/results/fit-1/report.html")
    page.get_by_role("link", name="Compare").click()
    accessible(page)
    with page.expect_download() as got:
        page.get_by_role("link", name="Export to Excel").click()
    assert got.value.suggested_filename == "subjects.xlsx"
    words = ["fit", "--config", "practice/subject.toml", "--out", "typed"]
    done = subprocess.run([sys.executable, "-m", "impc", *words], cwd=study, check=False,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})  # fmt: skip
    assert done.returncode == 0
    assert untimed(study / "practice/results/fit-1") == untimed(study / "typed")


def untimed(folder: Path) -> Any:
    """A result without dates, times and the command."""

    def kept(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        stated = ("made", "seconds", "command", "versions")
        return {key: value for key, value in pairs if key not in stated}

    return json.loads((folder / "result.json").read_text(), object_pairs_hook=kept)


def hostile(page: Page, report: Path) -> None:
    """A report of someone else runs nothing: no script, no request, no change of this page."""
    kept, title = report.read_text(encoding="utf-8"), page.title()
    script = "document.title='ran';parent.document.title='ran';fetch('../../../stop')"
    report.write_text(f'<script>{script}</script><h1>evil</h1><img src=x onerror="{script}">')
    page.reload()
    page.frame_locator("iframe").locator("h1").wait_for()
    assert page.title() == title
    assert page.frames[1].title() == ""
    report.write_text(kept, encoding="utf-8")
    page.reload()
