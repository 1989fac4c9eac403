"""Each message that docs/troubleshooting.md quotes is one of the package's."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from impc.cli.console import require_consent
from impc.cli.plant import find_plant
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.simulation import require_complete, scenario
from impc.errors import ImpcError
from impc.files.formats import read_table
from impc.files.plant_sources import PlantSource, make_plant
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Recording
from impc.studies.effort import Effort
from impc.studies.fit.settings import FitSettings, fit_settings
from impc.studies.fit.subject import fit_problem
from impc.studies.scheduler import Cluster, connected
from tests.documents.blocks import PAGES, ROOT
from tests.nonlinear.test_problem import made

MESSAGES = re.findall(r"\*\*`([^`]+)`\*\*", PAGES["docs/troubleshooting.md"].read_text("utf-8"))


def cart(growth: float = 1.1) -> Plant:
    return Plant(control.ss([[growth]], [[1]], [[1]], 0, 0.1))


def file(name: str, content: bytes) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        (folder / name).write_bytes(content)
        read_table(folder / name)

    return read


def settings(**table: Any) -> Callable[[Path], object]:
    return lambda _: fit_settings(table)


def saved(folder: Path) -> None:
    path = folder / "plant.json"
    path.write_text('{"A": [[1]], "B": [[1]], "C": [[1]], "dt": 1, "states": ["x", "v"]}')
    make_plant(find_plant(str(path), {}), ())


def nothing_holds(_: Path) -> None:
    """A gain of nothing, and a plant that grows."""
    plant = cart(1.2)
    law = Controller.from_gain(plant, [[0.0]], Bounds(plant), 5, terminal_set=False)
    require_complete(law, simulate(law, scenario(plant, x0=[5], steps=400)))


def short_trial(_: Path) -> None:
    trial = Recording(cart(), np.ones((20, 1)))
    fit_problem(cart(), [trial], FitSettings(settle=10))


#: Messages whose words are put together, and those that no other test provokes.
PROVOKED: dict[str, Callable[[Path], object]] = {
    "ends in ... and is a zip archive or an Excel workbook": file("t.csv", b"PK\3\4" + bytes(99)),
    "ends in ... and is an Excel workbook that is old or locked by a password": file(
        "t.xlsx", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(504)
    ),
    "[fit.structure] ...: is not a setting; see docs/fitting.md": settings(structure={"q": ""}),
    "[fit.observer] ...: is not a setting; see docs/fitting.md": settings(observer={"x": []}),
    "[fit] ...: got ...; give at most ...": settings(horizon=2**63),
    "names ... twice; name each once": settings(free=["mass", "mass"]),
    "is a ... that no result can keep": lambda _: find_plant("cursor", {"sample_time": 2**64}),
    "is an optimal control problem; impc fit takes one, this does not": lambda _: make_plant(
        PlantSource("mine:problem", made, {}), ()
    ),
    "names ... states and has ...": saved,
    "serve to find where it starts": short_trial,
    "the state left every reasonable range": nothing_holds,
    "would need ... GB of memory, more than this machine has": lambda _: require_consent(
        Effort(0, 1e9), given=False
    ),
    "needs --tls-..., ...; give the three files": lambda _: connected(
        Cluster("tls://127.0.0.1:9")
    ).__enter__(),
}
#: In other tests: damaged files, and drafts of a configuration.
ELSEWHERE = {
    "is a MATLAB table; save a struct of vectors",
    "is still '?'; fill in the column's unit",
    "is still '?'; fill in its name in the file",
    "is no output or disturbance of the plant",
}


def test_every_message_is_in_the_code() -> None:
    """Piece by piece: between dots, colons and semicolons."""
    trees = [ast.parse(path.read_text("utf-8")) for path in (ROOT / "impc").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    said = "\n".join(node.value for node in nodes if isinstance(node.value, str))
    assert len(MESSAGES) == len(set(MESSAGES)) > 100
    assert {*PROVOKED, *ELSEWHERE} <= set(MESSAGES)
    for message in set(MESSAGES).difference(PROVOKED, ELSEWHERE):
        for piece in re.split(r"\.\.\.|; |: ", message):
            assert piece.strip(" '(),:[]{}?=\"") in said, message


@pytest.mark.parametrize("message", PROVOKED)
def test_the_message_says_what_where_and_what_to_do(message: str, tmp_path: Path) -> None:
    with pytest.raises(ImpcError) as caught:
        PROVOKED[message](tmp_path)
    said = str(caught.value)
    assert re.search(".*".join(re.escape(part) for part in message.split("...")), said), said
    assert "\n" not in said
    assert all((caught.value.subject, caught.value.problem, caught.value.remedy))
