"""Code that a study file names does not run without consent."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

import impc.cli.plant as known
from impc.cli.main import main
from impc.errors import InputError
from impc.files.plant_sources import consented_name

OWN = "tests.studies.cohort.carts:cart_plant"
HOSTILE = """
[study]
{what} = "os:system"
recordings = "{{subject}}.csv"
[signals.y]
column = "y"
unit = "m"
[plant]
command = "touch evil"
[model]
command = "touch evil"
"""


def consent(name: str, given: str | None = None, allowed: bool = False) -> str:
    return consented_name("s.toml: study.plant", name, given, allowed, "plant", tuple(known.KNOWN))


@pytest.mark.parametrize("name", ["cursor", "seated-balance", "plants:cursor_plant", "p.mat"])
def test_what_the_package_has_needs_none(name: str) -> None:
    assert consent(name) == name


def test_the_users_own_needs_it() -> None:
    with pytest.raises(InputError, match=f"--plant {OWN} or --allow-plant"):
        consent(OWN)
    assert consent(OWN, allowed=True) == OWN
    assert consent("os:system", given=OWN) == OWN
    with pytest.raises(InputError, match="is missing"):
        consent("", allowed=True)


@pytest.mark.parametrize("name", ["evil:f.json", "evil:f.mat", "evil:f.npz", "a.json:f.json"])
def test_a_model_that_looks_like_a_file_is_code(name: str) -> None:
    with pytest.raises(InputError, match="names code that would be run"):
        consented_name("s.toml: study.model", name, None, False, "model", ())


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("cohort", "plant"),
        ("reliability", "plant"),
        ("select", "model"),
        ("key-parameters", "model"),
    ],
)
def test_no_command_runs_it_without_consent(
    command: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("1.csv").write_text("y\n1\n")
    Path("s.toml").write_text(HOSTILE.format(what=what))
    done = CliRunner().invoke(main, [command, "s.toml", "--out", "out"])
    assert done.exit_code == 2, done.output
    assert len(done.stderr.strip().splitlines()) == 1
    assert not Path("evil").exists()
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["fit", "compare"])
@pytest.mark.parametrize(
    ("plant", "more", "says"),
    [
        ("os:system", (), "s.toml: subject.plant: names code that would be run"),
        ("os:system", ("1.csv",), "s.toml: subject.plant: names code that would be run"),
        ("../p.mat", (), "s.toml: subject.plant: '../p.mat' is no path below its folder"),
        ("", (), "s.toml: subject.plant: is missing; name it, or pass --plant"),
        ("os:system", ("--allow-plant",), "system: expected a control.StateSpace"),
    ],
)
def test_a_subject_runs_no_code_without_consent(
    command: str, plant: str, more: tuple[str, ...], says: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("1.csv").write_text("y\n1\n")
    text = f'[subject]\nplant = "{plant}"\nfiles = ["1.csv"]\n[signals'
    Path("s.toml").write_text(text + HOSTILE.partition("[signals")[2].partition("[model]")[0])
    done = CliRunner().invoke(main, [command, "--config", "s.toml", "--out", "out", *more])
    assert done.exit_code == 2, done.output
    assert done.stderr.startswith(f"impc: error: {says}")
    assert Path("evil").exists() == ("--allow-plant" in more)
