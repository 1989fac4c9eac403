"""Code that a study file names: not without consent, and only the user's own."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

import impc.cli.plant as known
import plants
from impc.cli.main import main
from impc.errors import InputError
from impc.files.user_code import consented_name, require_users_function

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
    with pytest.raises(InputError, match=f"--plant {OWN}, or --allow-plant"):
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
    "name", ["os:system", "subprocess:run", "os.path:join", "numpy:load", "click:echo", "sys:exit"]
)
def test_code_of_others_is_refused_with_consent(name: str) -> None:
    for given, allowed in ((name, False), (None, True)):
        with pytest.raises(InputError, match=f"{name} is no function of a module of yours"):
            consent(name, given, allowed)


@pytest.mark.parametrize("name", ["..x:y", ":y", "a b:c", "a/../b:c", "a\nb:c"])
def test_what_is_no_name_of_a_module(name: str) -> None:
    with pytest.raises(InputError, match="is no module's name") as caught:
        consent(name, allowed=True)
    assert "\n" not in str(caught.value)


def test_what_a_module_of_yours_imported_is_not_yours(tmp_path: Path) -> None:
    for function in (subprocess.run, print, Path, "text"):
        with pytest.raises(InputError, match="no function of a module of yours"):
            require_users_function("s.toml", function)  # type: ignore[arg-type]
    require_users_function("s.toml", plants.cursor_plant)
    require_users_function("s.toml", consent)


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("cohort", "plant"),
        ("reliability", "plant"),
        ("select", "model"),
        ("key-parameters", "model"),
    ],
)
def test_no_command_runs_it(
    command: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("1.csv").write_text("y\n1\n")
    Path("s.toml").write_text(HOSTILE.format(what=what))
    for more in ((), (f"--allow-{what}",), (f"--{what}", "os:system")):
        done = CliRunner().invoke(main, [command, "s.toml", "--out", "out", *more])
        assert done.exit_code == 2, done.output
        assert len(done.stderr.strip().splitlines()) == 1
        assert not Path("evil").exists()
        assert not Path("out").exists()
