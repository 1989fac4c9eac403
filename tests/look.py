"""Every kind of page as a reader's eye has it, in a headless browser: `make look`.

    python -m tests.look [PAGE.html ...]

Without pages those of all commands are made, small. Each is opened in three widths, light and
dark, with its folds open, and `tests/look.js` says what is clipped, too pale, without words, out of
order, or code; its print may have four sheets, its file 0.8 MB. A page that has all of these faults
comes first: the program ends if one is not found. Pictures stay in results/look, to be compared.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca

import impc
from plants import yalmip_example
from tests.cli.test_plan import PLAN
from tests.support import easier_seat

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "results" / "look"
WIDTHS = (1500, 768, 400)
MOST_SHEETS, MOST_BYTES = 4, 800_000
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_POLICY = re.compile(r'(<meta http-equiv="Content-Security-Policy"\s+content="[^"]*)">')
# No window is as narrow as a phone: a frame is.
_AROUND = """<!DOCTYPE html><body style="margin: 0; width: 2800px"><script>
addEventListener("message", ({{data}}) => document.body.append(Object.assign(
  document.createElement("pre"), {{className: "look", hidden: true, textContent: data}})));
</script>{}</body>"""
_FRAME = '<iframe src="page.html" style="width: {}px; height: 6000px; border: 0"></iframe>'
_FAULTY = """<!DOCTYPE html><html><head>
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-AAAA'">
<title>faults</title></head>
<body style="background: #fff"><h1>One</h1><h1>Two</h1>
<p style="color: #ccc">pale</p><p>gain of K.command.theta1</p>
<div style="overflow: hidden; width: 90px"><p style="white-space: nowrap">cut at its end</p></div>
<p style="white-space: nowrap; width: 2000px">wide</p><a tabindex="3" href="#x">third</a>
<figure><svg width="50" height="20"><text x="40" y="15">outside</text></svg></figure>
<div class="chart" data-title="no chart"></div>
<table class="sortable"><thead><tr><th>head</th></tr></thead>
<tbody><tr><td>2</td></tr><tr><td>1</td></tr><tr><td>3</td></tr></tbody></table>
</body></html>"""


def main(pages: list[str]) -> int:
    """Look at the pages; 1 when something is found."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        print(f"make look needs one of {', '.join(_BROWSERS)}", file=sys.stderr)
        return 1
    KEPT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="impc-look-") as name:
        (faulty := Path(name, "page.html")).write_text(_FAULTY, encoding="utf-8")
        for width, seen in _look(browser, faulty, False).items():
            if missed := [what for what, places in seen.items() if not places]:
                print(f"the eye is blind at {width}: {', '.join(missed)}", file=sys.stderr)
                return 1
        shown = [Path(page) for page in pages] or _made(Path(name))
        return max([_identified(browser, page) for page in shown])


def _identified(browser: str, page: Path) -> int:
    seen: dict[str, list[str]] = {}
    for dark in ("", " dark"):
        for width, kinds in sorted(_look(browser, page, bool(dark)).items()):
            for what, places in kinds.items():
                if places:
                    seen.setdefault(f"{what}: {'; '.join(places[:12])}", []).append(
                        f"{width}{dark}"
                    )
    found = [f"{', '.join(where)}: {what}" for what, where in seen.items()]
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder, "page.pdf")
        _browse(browser, page, f"--print-to-pdf={printed}")
        sheets = len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes()))
    size = page.stat().st_size
    found += ["too long"] if sheets > MOST_SHEETS or size > MOST_BYTES else []
    print(f"{page.parent.name}/{page.name}: {sheets} A4, {size / 1e6:.2f} MB", *found, sep="\n  ")
    return int(bool(found))


def _browse(browser: str, page: Path, *given: str) -> str:
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
             "--disable-background-networking", "--disable-component-update", "--disable-sync",
             "--virtual-time-budget=5000", f"--user-data-dir={profile}", *given,
             page.absolute().as_uri()],
            capture_output=True, text=True, check=True, timeout=120,
        )  # fmt: skip
    return done.stdout


def _look(browser: str, page: Path, dark: bool) -> dict[int, dict[str, list[str]]]:
    """What `look.js` finds at each width: its words, and where; and a picture of all."""
    script = (ROOT / "tests" / "look.js").read_text(encoding="utf-8")
    # The page's policy lets its own script run, and nothing else: ours is added by its hash.
    seal = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    content, count = _POLICY.subn(rf"""\1 'sha256-{seal}'">""", page.read_text(encoding="utf-8"))
    assert count == 1, "the page has no policy, or more than one"
    with tempfile.TemporaryDirectory() as folder:
        copy, around = Path(folder, "page.html"), Path(folder, "around.html")
        content = content.replace("</body>", f"<script>{script}</script></body>")
        copy.write_text(content, encoding="utf-8")
        around.write_text(_AROUND.format("".join(map(_FRAME.format, WIDTHS))), encoding="utf-8")
        picture = KEPT / f"{page.parent.name}-{page.stem}{'-dark' * dark}.png"
        scheme = f"--blink-settings=preferredColorScheme={1 - dark}"
        dom = _browse(browser, around, "--window-size=2800,6000", scheme, "--dump-dom",
                      f"--screenshot={picture}")  # fmt: skip
    texts = re.findall(r'<pre class="look"[^>]*>(.*?)</pre>', dom, re.DOTALL)
    found = dict(json.loads(html.unescape(text)) for text in texts)
    assert {*found} == {*WIDTHS}, "the script did not run"
    return found


def _made(folder: Path) -> list[Path]:
    """A page of each command."""
    _impc(folder, "example", "--out", "example")
    _impc(folder, "simulate", "seated-balance", "--out", "seat", "--duration", "6",
          "--formats", "csv")  # fmt: skip
    config = folder / "seat" / "subject.toml"
    text = easier_seat(config.read_text(encoding="utf-8"))
    config.write_text(f'{text}\n[fit.structure]\nQ = "diagonal"\n', encoding="utf-8")
    trials = [f"seat/trial_{number}.csv" for number in (1, 2)]
    seat = ("--plant", "seated-balance", "--config", "seat/subject.toml")
    _impc(folder, "fit", *trials, *seat, "--out", "fit")
    config.write_text(text, encoding="utf-8")
    _impc(folder, "compare", *trials, *seat, "--out", "compare")
    _impc(folder, "simulate", "reliability-study", "--out", "visits", "--subjects", "3")
    _impc(folder, "reliability", "visits/study.toml", "--out", "reliability")
    _impc(folder, "simulate", "cohort", "--out", "people", "--subjects", "4", "--trials", "1",
          "--duration", "5", "--replicates", "0")  # fmt: skip
    _impc(folder, "cohort", "people/study.toml", "--out", "cohort", "--workers", "1")
    _impc(folder, "simulate", "head-tracking", "--out", "heads", "--subjects", "2", "--visits", "2",
          "--trials", "1", "--duration", "6")  # fmt: skip
    study = folder / "heads" / "study.toml"
    short = study.read_text(encoding="utf-8").replace("replicates = 200", "replicates = 20")
    study.write_text(f"{short}starts = 1\n", encoding="utf-8")
    _impc(folder, "select", "heads/study.toml", "--out", "select", "--workers", "1")
    _impc(folder, "key-parameters", "heads/study.toml", "--out", "key", "--bound", "0.03",
          "--workers", "1")  # fmt: skip
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    _impc(folder, "plan", "plan.toml", "--plant", "seated-balance", "--out", "plan")
    _from_python(folder)
    own = sorted((folder / "cohort" / "subjects").glob("*.html"))[:1]
    names = "example fit compare reliability cohort select key plan python nonlinear"
    return [*(folder / name / "report.html" for name in names.split()), *own]


def _from_python(folder: Path) -> None:
    """What `impc.report` writes: of the smallest example, and of a problem with a limit."""
    plant = impc.Plant(yalmip_example())
    bounds = impc.Bounds(plant, u_min=-1, u_max=1)
    law = impc.Controller(plant, impc.Weights([[1, 0], [0, 1]], 1), bounds, 3)
    recording = impc.Recording(plant, law.simulate([1, 3], 20).x)
    impc.report(impc.fit(impc.Problem(plant, bounds, 3, [recording])), folder / "python")
    x, u, drag, price = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("drag"), ca.SX.sym("price")
    problem = impc.OptimalControlProblem(
        x, u, {"drag": drag, "price": price}, x + 0.1 * ca.vertcat(x[1], u - drag * x[1] ** 3),
        price * x[0] ** 2 + u**2, 15, constraints={"push": ca.vertcat(u - 1, -u - 1)},
    )  # fmt: skip
    loop = problem.closed_loop({"drag": 0.3, "price": 5.0}, [1.0, 0.5], steps=20)
    trials = [problem.recorded_loop(loop.x, loop.u)]
    found = impc.fit_optimal_control(problem, trials, {"drag": 0.5, "price": 3.0})
    impc.report(found, folder / "nonlinear")


def _impc(folder: Path, *arguments: str) -> None:
    command = [sys.executable, "-m", "impc", *arguments]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
