"""Every kind of page as a reader's eye has it, in a headless browser: `make look`.

    python -m tests.look [PAGE.html ...]

Without pages those of all commands are made, small. Each is opened at the width of a desk and of a
phone, what is folded is opened, and `tests/look.js` says what is clipped, too pale, without words,
out of order, code, or an abbreviation that the page does not explain. The program begins with a
page that has all of these faults, and ends if one is not found.
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
from typing import Any

from impc.control.controller import Controller
from impc.inverse.estimates import Estimate
from impc.inverse.methods import fit
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.model.weights import Weights
from impc.studies.estimate_page import report
from plants import yalmip_example
from tests.cli.test_plan import PLAN
from tests.support import easier_seat

ROOT = Path(__file__).parents[1]
WIDTHS = (1500, 400)
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_POLICY = re.compile(r'(<meta http-equiv="Content-Security-Policy"\s+content="[^"]*)">')
_AROUND = """<!DOCTYPE html><body><script>
addEventListener("message", (identified) => {{
  const place = document.createElement("pre");
  place.id = "look";
  place.textContent = identified.data;
  document.body.append(place);
}});
</script><iframe src="page.html" style="width: {}px; height: 2000px; border: 0"></iframe></body>"""
_FAULTY = """<!DOCTYPE html><html><head>
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-AAAA'">
<title>faults</title></head>
<body style="background: #fff"><h1>One</h1><h1>Two</h1>
<p style="color: #ccc">pale</p><p>gain of K.command.theta1 in XYZ units</p>
<div style="overflow: hidden; width: 90px">
<p style="white-space: nowrap">cut at its right end</p></div>
<p style="white-space: nowrap; width: 2000px">wide</p><img><a tabindex="3" href="#x">third</a>
<details><summary>folded</summary><table class="numbers"><thead><tr><th>head</th></tr></thead>
<tbody><tr><td>2</td></tr><tr><td>1</td></tr></tbody></table></details>
<figure><img alt="one"><script type="application/json" class="chart">{}</script></figure>
<script>document.querySelector("nav").hidden = true;</script>
</body></html>"""


def main(pages: list[str]) -> int:
    """Look at the pages; 1 when something is found."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        print(f"make look needs one of {', '.join(_BROWSERS)}", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory(prefix="impc-look-") as name:
        folder = Path(name)
        (folder / "faulty.html").write_text(_FAULTY, encoding="utf-8")
        for width in WIDTHS:
            missed = [what for what, found in _look(browser, folder / "faulty.html", width).items()
                      if not found]  # fmt: skip
            if missed:
                print(f"the eye is blind at {width}: {', '.join(missed)}", file=sys.stderr)
                return 1
        shown = [Path(page) for page in pages] or _made(folder)
        return max([_identified(browser, page, width) for page in shown for width in WIDTHS])


def _identified(browser: str, page: Path, width: int) -> int:
    found = {what: places for what, places in _look(browser, page, width).items() if places}
    print(f"{page.parent.name}/{page.name} at {width}: {'nothing found' if not found else ''}")
    for what, places in found.items():
        print(f"  {what}: {'; '.join(places[:12])}")
    return int(bool(found))


def _look(browser: str, page: Path, width: int) -> dict[str, Any]:
    """What `look.js` finds: its words, and where."""
    script = (ROOT / "tests" / "look.js").read_text(encoding="utf-8")
    # The page's policy lets its own script run, and nothing else: ours is added by its hash.
    seal = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    content, count = _POLICY.subn(rf"""\1 'sha256-{seal}'">""", page.read_text(encoding="utf-8"))
    assert count == 1, "the page has no policy, or more than one"
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "page.html")
        copy.write_text(
            content.replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8"
        )
        # No window is as narrow as a phone: a frame is.
        around = Path(folder, "around.html")
        around.write_text(_AROUND.format(width), encoding="utf-8")
        done = subprocess.run(
            [browser, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1600,2000",
             "--virtual-time-budget=5000", f"--user-data-dir={folder}/profile", "--dump-dom",
             around.as_uri()],
            capture_output=True, text=True, check=True, timeout=120,
        )  # fmt: skip
    identified = re.search(r'<pre id="look">(.*?)</pre>', done.stdout, re.DOTALL)
    assert identified, "the script did not run"
    found: dict[str, Any] = json.loads(html.unescape(identified[1]))
    assert found.pop("width") == width
    return found


def _made(folder: Path) -> list[Path]:
    """A page of each command; subjects whose page has another kind too."""
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
    _impc(folder, "simulate", "head-tracking", "--out", "heads", "--subjects", "1", "--trials", "1",
          "--duration", "6")  # fmt: skip
    study = folder / "heads" / "study.toml"
    shorter = study.read_text(encoding="utf-8").replace("replicates = 200", "replicates = 20")
    study.write_text(shorter.replace("size = 5", "size = 9"), encoding="utf-8")
    _impc(folder, "select", "heads/study.toml", "--out", "select", "--workers", "1")
    _impc(folder, "simulate", "head-tracking", "--out", "twice", "--subjects", "2", "--visits", "2",
          "--trials", "1", "--duration", "6")  # fmt: skip
    study = folder / "twice" / "study.toml"
    short = study.read_text(encoding="utf-8").replace("replicates = 200", "replicates = 20")
    study.write_text(f"{short}starts = 1\n", encoding="utf-8")
    _impc(folder, "key-parameters", "twice/study.toml", "--out", "key", "--bound", "0.03",
          "--workers", "1")  # fmt: skip
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    _impc(folder, "plan", "plan.toml", "--plant", "seated-balance", "--out", "plan")
    report(_estimate(), folder / "python")
    own = sorted((folder / "cohort" / "subjects").glob("*.html"))[:1]
    commands = ("example", "fit", "compare", "reliability", "cohort", "select", "key", "plan",
                "python")  # fmt: skip
    return [*(folder / name / "report.html" for name in commands), *own]


def _estimate() -> Estimate:
    """Of the smallest example: what `impc.report` writes from Python."""
    plant = Plant(yalmip_example())
    bounds = Bounds(plant, u_min=-1, u_max=1)
    law = Controller(plant, Weights([[1, 0], [0, 1]], 1), bounds, 3)
    return fit(Problem(plant, bounds, 3, [Recording(plant, law.simulate([1, 3], 20).x)]))


def _impc(folder: Path, *arguments: str) -> None:
    command = [sys.executable, "-m", "impc", *arguments]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
