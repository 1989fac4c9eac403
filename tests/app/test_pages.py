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
from tests.app.serving import ROOT, Client, german, serving, sheet
from tests.files.samples import workbook

NAME = "VP 07"
BODY = {"plant": "seated-balance", "plant.mass": "82,5", "plant.height": "1.80", "u_max": "6,5",
        "horizon": "20"}  # fmt: skip


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with serving(tmp_path_factory.mktemp("study")) as found:
        yield found


@pytest.fixture
def study(client: Client) -> Iterator[Path]:
    """A folder with that of one subject, made anew for each test."""
    root = Path(client.process.args[-1])  # type: ignore[index,arg-type]
    (root / NAME).mkdir()
    for trial in (1, 2):
        german(root / NAME / f"Versuch {trial}.csv", trial)
    yield root
    for path in root.iterdir():
        if path.is_symlink():
            path.unlink()
        else:
            shutil.rmtree(path)


def written(study: Path) -> dict[str, Any]:
    return tomllib.loads((study / NAME / "subject.toml").read_text(encoding="utf-8"))


def fields(**changed: str) -> dict[str, str]:
    """The form of the signals as the browser sends it at first."""
    found = {"file": "Versuch 1.csv", "subject": ""}
    for index, role in enumerate(("time", "theta1", "theta2", "perturbation")):
        found |= {f"role.{index}": role, f"sign.{index}": "1"}
        found |= {f"{key}.{index}": "" for key in ("unit", "offset", "limit")}
    return found | {"unit.0": "s", "unit.3": "Nm"} | changed


ANSWERED = fields(
    **{"subject": "VP07", "unit.1": "deg", "unit.2": "deg", "sign.2": "-1", "limit.1": "12,0"},
    **dict.fromkeys(("sure.1", "sure.2", "sure.3"), "on"),
)


def test_questions_are_answered_and_saved(client: Client, study: Path) -> None:
    start = client.get("").text
    assert "2 recordings, not begun" in start
    assert "Practise with a simulated person" in start
    page = client.get("signals", f=NAME).text
    assert "ambiguous" in page  # Grad
    assert "Störmoment" in page
    assert not (study / NAME / "subject.toml").exists()  # reading writes nothing
    assert "I have checked it" not in client.post("signals", ANSWERED, f=NAME).text
    found = written(study)
    assert found["recording"]["subject"] == "VP07"
    assert found["signals"]["theta1"] == {"column": "Sitzwinkel", "unit": "deg", "limit": 12.0}
    assert found["signals"]["theta2"]["sign"] == -1
    assert found["subject"]["files"] == ["Versuch 1.csv", "Versuch 2.csv"]
    known = impc.read_configuration(study / NAME / "subject.toml")
    assert known.signals["perturbation"].column == "Störmoment"


def test_what_cannot_be_is_told_and_not_kept(client: Client, study: Path) -> None:
    client.post("signals", ANSWERED, f=NAME)
    assert "Body mass" in client.get("body", f=NAME).text
    assert "Saved." in client.post("body", BODY, f=NAME).text
    found = written(study)
    assert (found["plant"]["mass"], found["fit"]) == (82.5, {"horizon": 20, "u_max": 6.5})
    before = (study / NAME / "subject.toml").read_bytes()
    for step, form, said in (
        ("signals", ANSWERED | {"role.1": "theta2"}, "is chosen for"),
        ("signals", ANSWERED | {"offset.1": "<b>x"}, "give a number such as 12.5"),
        ("signals", ANSWERED | {"unit.2": "Grad"}, "write deg for degrees"),
        ("signals", ANSWERED | {"unit.2": "Nm"}, "Not saved"),
        ("signals", ANSWERED | {"start": "2", "stop": "1"}, "Not saved"),
        ("body", BODY | {"horizon": "0,2"}, "Not saved"),
        ("body", BODY | {"u_max": "-6"}, "give a positive number"),
        ("body", BODY | {"plant.mass": "-3"}, "Not saved"),
        ("body", BODY | {"plant.mass": "abc"}, "Not saved"),
    ):
        page = client.post(step, form, f=NAME).text
        assert said in page
        assert "<b>x" not in page
        assert (study / NAME / "subject.toml").read_bytes() == before
    client.post("body", BODY | {"no_limit": "on"}, f=NAME)
    assert "u_max" not in written(study)["fit"]


def test_a_code_for_missing_values_is_asked_for(client: Client, study: Path) -> None:
    path = study / NAME / "Versuch 1.csv"
    lines = path.read_bytes().decode("cp1252").split("\r\n")
    for row in range(40, 340, 20):
        cells = lines[row].split(";")
        lines[row] = ";".join([cells[0], "-9999", *cells[2:]])
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    assert "does it mark missing values?" in client.get("signals", f=NAME).text
    for answer, kept in (("yes", -9999.0), ("no", []), ("", None)):
        client.post("signals", ANSWERED | {"missing.1": answer}, f=NAME)
        assert written(study)["signals"]["theta1"].get("missing") == kept


def test_two_trials_in_a_file_are_named(client: Client, study: Path) -> None:
    for path in (study / NAME).glob("*.csv"):
        head, *rows = path.read_bytes().split(b"\r\n")
        path.write_bytes(b"\r\n".join([head, *rows, *rows]))
    page = client.get("signals", f=NAME).text
    assert "Zeit begins again in sample 601" in page
    assert "save each trial as a file of its own" in page


def test_a_sheet_is_chosen(client: Client, study: Path) -> None:
    table = impc.read_table(study / NAME / "Versuch 1.csv")
    first = impc.make_table("", {f"{name}_raw": one for name, one in table.columns.items()})
    workbook(study / NAME / "Versuch 0.xlsx", Rohdaten=sheet(first), Gefiltert=sheet(table))
    form = ANSWERED | {"file": "Versuch 0.xlsx", "sheet": "Gefiltert"}
    assert ">Sitzwinkel_raw</legend>" in client.get("signals", f=NAME).text
    assert client.post("signals", form, f=NAME).headers["hx-refresh"] == "true"
    assert ">Sitzwinkel_raw</legend>" not in client.get("signals", f=NAME).text
    assert written(study)["recording"]["sheet"] == "Gefiltert"


def test_recordings_are_dropped_chosen_and_never_replaced(client: Client, study: Path) -> None:
    client.post("signals", ANSWERED, f=NAME)
    text = (study / NAME / "Versuch 1.csv").read_bytes()
    assert client.post("drop", text, f=NAME, name="Versuch 3.csv").status == 204
    assert written(study)["subject"]["files"][-1] == "Versuch 3.csv"
    assert client.post("drop", b"other", f=NAME, name="Versuch 3.csv").status == 409
    assert (study / NAME / "Versuch 3.csv").read_bytes() == text
    client.post("use", {"use.Versuch 1.csv": "on", "use.Versuch 2.csv": "on"}, f=NAME)
    assert written(study)["subject"]["files"] == ["Versuch 1.csv", "Versuch 2.csv"]
    for name in ("notes.docx", ".hidden.csv", "~lock.csv", "..", "a\n.csv", "subject.toml"):
        assert client.post("drop", b"1", f=NAME, name=name).status == 415
    for name in ("../up.csv", "/tmp/up.csv", f"{NAME}/../up.csv"):  # the base name only
        assert client.post("drop", b"a,b\n1,2\n", f=NAME, name=name).status in (204, 409)
    assert (study / NAME / "up.csv").exists()
    assert not (study / "up.csv").exists()
    assert client.post("signals", b"a=" + b"x" * 2_000_000, f=NAME).status == 413


def test_a_full_disk_loses_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    german(folder / "Versuch 1.csv")
    with serving(folder) as client:
        client.post("signals", ANSWERED, f="")
    before = sorted((path.name, path.read_bytes()) for path in folder.iterdir())
    # No file of more than 1 kB can be written, as where no space is left.
    program = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024)); "
    limited = [sys.executable, "-c", f"{program}os.execv(sys.argv[1], sys.argv[1:])"]
    with serving(folder, *limited) as client:
        page = client.post("drop", b"1\n" * 9999, f="", name="Versuch 2.csv")
        assert (page.status, "cannot be written" in page.text) == (507, True)
        page = client.post("signals", ANSWERED | {"subject": "VP08"}, f="")
        assert "free disk space and start again" in page.text
        assert client.get("signals").status == 200
    assert sorted((path.name, path.read_bytes()) for path in folder.iterdir()) == before


@pytest.mark.parametrize("name", ["..", "../..", "/etc", f"{NAME}/../..", ".hidden", "no", "link"])
def test_no_folder_outside_is_opened(name: str, client: Client, study: Path) -> None:
    (study / ".hidden").mkdir()
    (study / "link").symlink_to(study.parent)
    assert client.get("recordings", f=name).status == 400


def test_names_are_escaped(client: Client, study: Path) -> None:
    folder = study / "<b>hostile"
    folder.mkdir()
    rows = "".join(f"{k},{k * k}\n" for k in range(99))
    (folder / "<img src=x onerror=alert(1)>.csv").write_text(f"t,<script>alert(1)</script>\n{rows}")
    for page in (client.get("").text, client.get("recordings", f="<b>hostile").text,
                 client.get("signals", f="<b>hostile").text):  # fmt: skip
        for wrong in ("<b>hostile", "<img src=x", "<script>alert"):
            assert wrong not in page


def test_only_listed_results_are_served_and_reports_in_a_sandbox(
    client: Client, study: Path
) -> None:
    out = study / NAME / "results/fit-1"
    out.mkdir(parents=True)
    (out / "report.html").write_text("<script>parent.document.title = 1</script>")
    (out / "tables.xlsx").write_bytes(b"PK")
    (out / "secret.txt").write_text("secret")
    (study.parent / "secret.html").write_text("secret")
    (out / "link.html").symlink_to(study.parent / "secret.html")
    (out / ".impc").write_text('fit\n["report.html", ""]\n["tables.xlsx", ""]\n["link.html", ""]\n')
    place = "file/VP%2007/results/fit-1"
    policy = client.get(f"{place}/report.html").headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts")
    assert "script-src 'sha256-" in policy
    assert "'self'" not in policy.partition("script-src")[2].partition(";")[0]
    table = client.get(f"{place}/tables.xlsx")
    assert table.headers["content-disposition"].startswith("attachment")
    for name in ("secret.txt", ".impc", "link.html", "../fit-1/secret.txt", "..%2f..%2fx.toml"):
        assert client.get(f"{place}/{name}").status == 404
    assert client.get("file//etc/passwd").status == 404
    assert client.get("static/../page.html").status == 404


def test_results_say_what_changed_between_fits(client: Client, study: Path) -> None:
    client.post("signals", ANSWERED, f=NAME)
    text = (study / NAME / "subject.toml").read_text(encoding="utf-8")
    for number in (1, 2):
        out = study / NAME / f"results/fit-{number}"
        out.mkdir(parents=True)
        (out / "result.json").write_text("{}")
        limit = text.replace('u_max = "?"', f"u_max = {5.0 + number}")
        (out / "configuration.toml").write_text(limit, encoding="utf-8")
    page = client.get("results", f=NAME).text
    assert "fit.u_max 6.0 → 7.0" in page or "fit.u_max 7.0 → 6.0" in page
    assert "Changed since the newest fit: fit.u_max" in page


def test_code_that_the_file_names_is_not_run(client: Client, study: Path) -> None:
    (study / NAME / "evil.py").write_text("raise SystemExit('was run')")
    text = '[subject]\nplant = "evil:plant"\nfiles = ["Versuch 1.csv"]\n'
    (study / NAME / "subject.toml").write_text(text)
    assert "names code that would be run" in client.get("signals", f=NAME).text


def test_a_file_that_is_deleted_elsewhere_stops_no_page(client: Client, study: Path) -> None:
    both = {"use.Versuch 1.csv": "on", "use.Versuch 2.csv": "on"}
    assert client.post("use", both, f=NAME).status == 204
    (study / NAME / "Versuch 2.csv").unlink()
    answer = client.post("signals", ANSWERED | {"file": "Versuch 2.csv"}, f=NAME)
    assert (answer.status, "does not exist" in answer.text) == (200, True)
    for step in ("signals", "body", "fit", "results"):
        assert client.get(step, f=NAME).status == 200
    page = client.get("recordings", f=NAME).text
    assert "is named in subject.toml and not in the folder" in page
    assert client.post("use", {"use.Versuch 1.csv": "on"}, f=NAME).status == 204
    assert "Versuch 2.csv" not in client.get("recordings", f=NAME).text


def test_a_plant_of_the_folder_stays_and_is_that_of_the_fit(client: Client, study: Path) -> None:
    names = {"inputs": ["torque"], "outputs": ["angle"]}
    matrices = {"A": [[0.9]], "B": [[0.1]], "C": [[1.0]], "dt": 0.01}
    plant = study / NAME / "stick.npz"
    np.savez(plant, **matrices, **names)  # type: ignore[arg-type]
    (study / NAME / "subject.toml").write_text(
        '[subject]\nplant = "stick.npz"\nfiles = ["Versuch 1.csv"]\n[recording]\ntime = "Zeit"\n'
        '[signals.angle]\ncolumn = "Sitzwinkel"\nunit = "deg"\n[fit]\nhorizon = 5\n'
    )
    assert f"<option selected>{plant}</option>" in client.get("body", f=NAME).text
    given = {"plant": str(plant), "u_max": "3", "horizon": "5"}
    assert "Saved." in client.post("body", given, f=NAME).text
    found = written(study)
    assert (found["subject"]["plant"], found["fit"]["u_max"]) == ("stick.npz", 3.0)
    page = client.get("fit", f=NAME).text
    assert "impc fit --config &#39;VP 07/subject.toml&#39;" in page
    assert "Checking the recordings" in page
    assert "1 trial, about" in client.part("fit", "fit", f=NAME)


@pytest.mark.parametrize(
    "text",
    [
        "[subject]\nfiles = 3\n",
        "subject = 1\n",
        '[subject]\nfiles = ["../x.csv"]\n[signals.x]\ncolumn = "a"\nunit = "deg"\n',
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
    (study / NAME / "subject.toml").write_text(text)
    for step in ("recordings", "signals", "body", "fit"):
        page = client.get(step, f=NAME)
        assert page.status == 400
        said = page.text.partition('role="alert">')[2].partition("</p>")[0]
        assert said.startswith(("subject.toml", "configuration"))
        assert "\n" not in said
        assert "Steps" in page.text  # the way out
    assert client.get("").status == 200  # the others go on


def test_the_server_starts_without_the_slow_libraries() -> None:
    program = "import sys, impc.app.guard, impc.app.web; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert "impc.app.fits" in done.stdout.split()
    assert not {"casadi", "numba", "control", "matplotlib", "pandas"} & set(done.stdout.split())
