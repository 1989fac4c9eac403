"""The pages write the answers into subject.toml, keep the rest, and serve nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import impc
from tests.app.serving import ROOT, Client, serving

STAMPS = np.arange(600) / 100


def german(path: Path, seed: int) -> None:
    """A recording as a German export: semicolons, decimal commas, umlauts, cp1252."""
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.choice([-5.0, 0.0, 5.0], 60), 10)
    angle = np.cumsum(push) / 300
    lines = ["Zeit [s];Sitzwinkel [Grad];Rumpfwinkel;Störmoment [Nm]"]
    rows = zip(STAMPS, angle, 0.5 * np.roll(angle, 7), push, strict=True)
    lines += [";".join(f"{value:.5f}".replace(".", ",") for value in row) for row in rows]
    path.write_bytes("\r\n".join(lines).encode("cp1252"))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with that of one subject."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "VP 07").mkdir()
    for seed in (1, 2):
        german(folder / "VP 07" / f"Versuch {seed}.csv", seed)
    return folder


@pytest.fixture(scope="module")
def client(study: Path) -> Iterator[Client]:
    with serving(study, home=study.parent / "home") as found:
        yield found


def written(study: Path) -> dict[str, Any]:
    return tomllib.loads((study / "VP 07/subject.toml").read_text(encoding="utf-8"))


def fields(**changed: str) -> dict[str, str]:
    """The form of the signals as the browser sends it at first."""
    found = {"file": "Versuch 1.csv", "subject": ""}
    for index, role in enumerate(("time", "theta1", "theta2", "perturbation")):
        found[f"role.{index}"] = role
        found |= {f"{key}.{index}": "" for key in ("unit", "offset", "limit")}
        found[f"sign.{index}"] = "1"
    return found | {"unit.0": "s", "unit.3": "Nm"} | changed


def test_the_start_names_folders_and_their_state(client: Client) -> None:
    page = client.get("")
    assert page.status == 200
    assert "VP 07" in page.text
    assert "2 recordings, not begun" in page.text
    assert "Practise with a simulated person" in page.text


def test_questions_are_answered_and_saved(client: Client, study: Path) -> None:
    page = client.get("signals", f="VP 07").text
    assert "ambiguous" in page  # Grad
    assert "Störmoment" in page
    assert not (study / "VP 07/subject.toml").exists()  # reading writes nothing
    sure = dict.fromkeys(("sure.1", "sure.2", "sure.3"), "on")
    units = {"unit.1": "deg", "unit.2": "deg", "sign.2": "-1", "limit.1": "12,0"}
    answered = fields(subject="VP07", **units, **sure)
    page = client.post("signals", answered, f="VP 07").text
    found = written(study)
    assert found["recording"]["subject"] == "VP07"
    assert found["signals"]["theta1"] == {"column": "Sitzwinkel", "unit": "deg", "limit": 12.0}
    assert found["signals"]["theta2"]["sign"] == -1
    assert found["subject"]["files"] == ["Versuch 1.csv", "Versuch 2.csv"]
    assert "I have checked it" not in page
    known = impc.read_configuration(study / "VP 07/subject.toml")
    assert known.signals["perturbation"].column == "Störmoment"


def test_a_role_is_given_once_and_numbers_are_numbers(client: Client, study: Path) -> None:
    before = (study / "VP 07/subject.toml").read_bytes()
    twice = fields(**{"role.1": "theta2"})
    assert "is chosen for" in client.post("signals", twice, f="VP 07").text
    wrong = fields(**{"offset.1": "<b>x"})
    page = client.post("signals", wrong, f="VP 07").text
    assert "give a number such as 12.5" in page
    assert "<b>x" not in page
    assert (study / "VP 07/subject.toml").read_bytes() == before


def test_body_and_limit_are_saved_and_what_the_plant_refuses_is_not(
    client: Client, study: Path
) -> None:
    page = client.get("body", f="VP 07").text
    assert "Body mass" in page
    given = {"plant": "seated-balance", "plant.mass": "82,5", "plant.height": "1.80",
             "u_max": "6,5", "horizon": "20"}  # fmt: skip
    assert "Saved." in client.post("body", given, f="VP 07").text
    found = written(study)
    assert found["plant"]["mass"] == 82.5
    assert found["fit"] == {"horizon": 20, "u_max": 6.5}
    before = (study / "VP 07/subject.toml").read_bytes()
    assert "Not saved" in client.post("body", given | {"plant.mass": "-3"}, f="VP 07").text
    assert "Not saved" in client.post("body", given | {"plant.mass": "abc"}, f="VP 07").text
    assert (study / "VP 07/subject.toml").read_bytes() == before
    client.post("body", given | {"no_limit": "on"}, f="VP 07")
    assert "u_max" not in written(study)["fit"]


def test_recordings_are_dropped_chosen_and_never_replaced(client: Client, study: Path) -> None:
    text = (study / "VP 07/Versuch 1.csv").read_bytes()
    assert client.post("drop", text, f="VP 07", name="Versuch 3.csv").status == 204
    assert written(study)["subject"]["files"][-1] == "Versuch 3.csv"
    assert client.post("drop", b"other", f="VP 07", name="Versuch 3.csv").status == 409
    assert (study / "VP 07/Versuch 3.csv").read_bytes() == text
    client.post("use", {"use.Versuch 1.csv": "on", "use.Versuch 2.csv": "on"}, f="VP 07")
    assert written(study)["subject"]["files"] == ["Versuch 1.csv", "Versuch 2.csv"]
    for name in ("notes.docx", ".hidden.csv", "~lock.csv", "..", "a\n.csv", "subject.toml"):
        assert client.post("drop", b"1", f="VP 07", name=name).status == 415
    for name in ("../up.csv", "/tmp/up.csv", "VP 07/../up.csv"):  # the base name only
        assert client.post("drop", b"a,b\n1,2\n", f="VP 07", name=name).status in (204, 409)
    assert (study / "VP 07/up.csv").exists()
    assert not (study / "up.csv").exists()
    (study / "VP 07/up.csv").unlink()
    assert client.post("signals", b"a=" + b"x" * 2_000_000, f="VP 07").status == 413


@pytest.mark.parametrize("folder", ["..", "../..", "/etc", "VP 07/../..", ".hidden", "missing"])
def test_no_folder_outside_is_opened(folder: str, client: Client, study: Path) -> None:
    (study / ".hidden").mkdir(exist_ok=True)
    assert client.get("recordings", f=folder).status == 400


def test_a_link_does_not_lead_out(client: Client, study: Path) -> None:
    (study / "out").symlink_to(study.parent)
    assert client.get("recordings", f="out").status == 400
    (study / "out").unlink()


def test_names_are_escaped(client: Client, study: Path) -> None:
    folder = study / "<b>hostile"
    folder.mkdir()
    rows = "".join(f"{k},{k * k}\n" for k in range(99))
    (folder / "<img src=x onerror=alert(1)>.csv").write_text(f"t,<script>alert(1)</script>\n{rows}")
    for page in (client.get("").text, client.get("recordings", f="<b>hostile").text,
                 client.get("signals", f="<b>hostile").text):  # fmt: skip
        for wrong in ("<b>hostile", "<img src=x", "<script>alert"):
            assert wrong not in page
    shutil.rmtree(folder)


def test_only_listed_results_are_served_and_reports_in_a_sandbox(
    client: Client, study: Path
) -> None:
    out = study / "VP 07/results/fit-1"
    out.mkdir(parents=True)
    (out / "report.html").write_text("<script>parent.document.title = 1</script>")
    (out / "tables.xlsx").write_bytes(b"PK")
    (out / "secret.txt").write_text("secret")
    (study / "secret.html").write_text("secret")
    (out / "link.html").symlink_to(study / "secret.html")
    (out / ".impc").write_text('fit\n["report.html", ""]\n["tables.xlsx", ""]\n["link.html", ""]\n')
    place = "file/VP%2007/results/fit-1"
    page = client.get(f"{place}/report.html")
    policy = page.headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "script-src 'sha256-" in policy
    assert "'self'" not in policy.partition("script-src")[2].partition(";")[0]
    table = client.get(f"{place}/tables.xlsx")
    assert table.headers["content-disposition"].startswith("attachment")
    for name in (
        "secret.txt",
        ".impc",
        "link.html",
        "../fit-1/secret.txt",
        "..%2f..%2fsubject.toml",
    ):
        assert client.get(f"{place}/{name}").status == 404
    assert client.get("file//etc/passwd").status == 404
    assert client.get("static/../page.html").status == 404
    shutil.rmtree(study / "VP 07/results")


def test_code_that_the_file_names_is_not_run(client: Client, study: Path) -> None:
    folder = study / "code"
    folder.mkdir()
    german(folder / "a.csv", 3)
    (folder / "evil.py").write_text("raise SystemExit('was run')")
    (folder / "subject.toml").write_text('[subject]\nplant = "evil:plant"\nfiles = ["a.csv"]\n')
    page = client.get("signals", f="code")
    assert "names code that would be run" in page.text
    shutil.rmtree(folder)


def test_a_file_that_is_deleted_elsewhere_stops_no_page(client: Client, study: Path) -> None:
    folder = study / "gone"
    folder.mkdir()
    for seed in (1, 2):
        german(folder / f"{seed}.csv", seed)
    assert client.post("use", {"use.1.csv": "on", "use.2.csv": "on"}, f="gone").status == 204
    (folder / "2.csv").unlink()
    for step in ("signals", "body", "fit", "results"):
        assert client.get(step, f="gone").status == 200
    page = client.get("recordings", f="gone").text
    assert "is named in subject.toml and not in the folder" in page
    assert client.post("use", {"use.1.csv": "on"}, f="gone").status == 204
    assert "2.csv" not in client.get("recordings", f="gone").text
    shutil.rmtree(folder)
    assert client.get("signals", f="gone").status == 400


def test_a_plant_of_the_folder_stays_and_is_that_of_the_fit(client: Client, study: Path) -> None:
    folder = study / "own"
    folder.mkdir()
    german(folder / "a.csv", 5)
    names = {"inputs": ["torque"], "outputs": ["angle"]}
    matrices = {"A": [[0.9]], "B": [[0.1]], "C": [[1.0]], "dt": 0.01}
    np.savez(folder / "stick.npz", **matrices, **names)  # type: ignore[arg-type]
    (folder / "subject.toml").write_text(
        '[subject]\nplant = "stick.npz"\nfiles = ["a.csv"]\n[recording]\ntime = "Zeit"\n'
        '[signals.angle]\ncolumn = "Sitzwinkel"\nunit = "deg"\n[fit]\nhorizon = 5\n'
    )
    page = client.get("body", f="own").text
    assert f"<option selected>{folder / 'stick.npz'}</option>" in page
    given = {"plant": str(folder / "stick.npz"), "u_max": "3", "horizon": "5"}
    assert "Saved." in client.post("body", given, f="own").text
    found = tomllib.loads((folder / "subject.toml").read_text())
    assert (found["subject"]["plant"], found["fit"]["u_max"]) == ("stick.npz", 3.0)
    page = client.get("fit", f="own").text
    assert "impc fit --config own/subject.toml --out own/results/fit-1" in page
    assert "is clipped at" in page  # by the check of the fit, with this plant
    shutil.rmtree(folder)


@pytest.mark.parametrize(
    "text",
    [
        "[subject]\nfiles = 3\n",
        "subject = 1\n",
        '[subject]\nfiles = ["../VP 07/Versuch 1.csv"]\n[signals.x]\ncolumn = "a"\nunit = "deg"\n',
        "[signals]\ntheta1 = 4\n",
        '[signals.theta1]\ncolumn = "a"\nunit = 3\n',
        '[recording]\ntime = [1]\n[signals.x]\ncolumn = "a"\nunit = "deg"\n',
        "= no toml",
        "\x00",
        "a." * 40 + "b = 1\n",
    ],
)
def test_a_file_of_answers_that_is_wrong_is_one_line(
    text: str, client: Client, study: Path
) -> None:
    folder = study / "wrong"
    folder.mkdir(exist_ok=True)
    german(folder / "a.csv", 4)
    (folder / "subject.toml").write_text(text)
    answers = [client.get(step, f="wrong") for step in ("recordings", "signals", "body", "fit")]
    for one in answers:
        assert one.status == 400
        assert one.text.startswith(("subject.toml", "configuration"))
        assert one.text.count("\n") == 1
    assert client.get("").status == 200  # the others go on
    shutil.rmtree(folder)


def test_the_server_starts_without_the_slow_libraries() -> None:
    program = "import sys, impc.app.guard, impc.app.web; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert "impc.app.fits" in done.stdout.split()
    assert not {"casadi", "numba", "control", "matplotlib"} & set(done.stdout.split())
