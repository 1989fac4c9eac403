"""A digest changes whenever any input of a result changes."""

from __future__ import annotations

import importlib
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import control
import numpy as np
import pytest

from impc.checking import replace
from impc.errors import DataError
from impc.files.configuration import Configuration, RecordingTable, ReportTable, SignalTable
from impc.files.digests import content_digest, digest, source_digest
from impc.inverse.problem import Problem
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.plant_family import PlantFamily
from impc.model.recordings import Recording
from impc.studies.cache import Cache
from impc.studies.cohort.tasks import unit_digest
from impc.studies.fit.memory import open_memory
from impc.studies.fit.settings import FitSettings


@dataclass(frozen=True)
class One:
    x: object


def test_values_that_differ_in_anything_differ() -> None:
    values = [
        None, True, 1, 1.0, "1", b"1", "", "a\x00", -0.0, 0.0, float("nan"), (), (1,), ((1,),),
        {"a": 1}, {"a": "1"}, ("ab", "c"), ("a", "bc"), One(1), One(2),
        np.array([1.0]), np.array([[1.0]]), np.array([1]), np.array([1.0], dtype=np.float32),
        np.array([1.0 + 2**-52]), Path("b"), SignalTable("a", "m"), SignalTable("a", "m", sign=-1),
    ]  # fmt: skip
    found = [digest(value) for value in values]
    assert len(set(found)) == len(values)
    assert digest(1, 2) != digest((1, 2))
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest(np.float64(2.5)) == digest(2.5)
    for wrong in (abs, object(), np.array([object()])):
        with pytest.raises(TypeError, match="no digest"):
            digest(wrong)


def test_a_file_is_read_from_end_to_end(tmp_path: Path) -> None:
    """One byte changed in the middle of 300 kB, with the same size and time stamps."""
    path = tmp_path / "a.csv"
    path.write_bytes(bytes(300_000))
    before, stamp = content_digest(path), path.stat()
    changed = bytearray(300_000)
    changed[150_000] = 1
    path.write_bytes(changed)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    assert content_digest(path) != before
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "nothing", "x" * 300):
        with pytest.raises(DataError):
            content_digest(tmp_path / name)


@pytest.mark.parametrize("where", ["plant", "body", "deep/inner", "deep/near", "broken"])
def test_code_of_a_plant_and_of_what_it_imports(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1.0 to 1.6 in the module, in modules that it imports, and in one that cannot be parsed."""
    texts = {
        "plant": "LENGTH = 1.0\nfrom body import MASS\ndef make():\n    from deep.inner import G\n",
        "body": "MASS = 1.0\n",
        "deep/inner": "from .near import H\nG = 1.0\ndef never():\n    import broken\n",
        "deep/near": "H = 1.0\n",
        "broken": "H = 1.0 (\n",
    }
    found: list[str] = []
    for number, length in enumerate(("1.0", "1.0", "1.6")):
        folder = tmp_path / str(number)
        for name, text in texts.items():
            path = folder / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text.replace("= 1.0", f"= {length}") if name == where else text)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(str(folder))
            importlib.invalidate_caches()
            importlib.import_module("plant")
            found.append(source_digest("plant:make"))
        for name in ("plant", "body", "deep", "deep.inner"):
            sys.modules.pop(name, None)
    assert found[0] == found[1]
    assert found[0] != found[2]


def test_a_plant_file_and_files_that_are_arguments(tmp_path: Path) -> None:
    plant, table = tmp_path / "p.json", tmp_path / "masses.csv"
    plant.write_text("{}")
    table.write_text("1")
    first = source_digest(str(plant))
    by_name = source_digest("plants:cursor_plant", {"masses": str(table), "size": 1.0})
    plant.write_text("{ }")
    table.write_text("2")
    assert source_digest(str(plant)) != first
    assert source_digest("plants:cursor_plant", {"masses": str(table), "size": 1.0}) != by_name


def test_a_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text(name)
    configuration = Configuration(
        RecordingTable(rate=100.0), {"y": SignalTable("y", "deg")}, fit={"horizon": 20}
    )
    files = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    base = unit_digest(files, "plants:cursor_plant", {"mass": 1.0}, configuration)

    def other(**changed: object) -> str:
        given = {"files": files, "plant": "plants:cursor_plant", "arguments": {"mass": 1.0},
                 "configuration": configuration} | changed  # fmt: skip
        return unit_digest(**given)  # type: ignore[arg-type]

    assert other() == base
    msgspec_replaced = Configuration(
        RecordingTable(rate=100.0), {"y": SignalTable("y", "rad")}, fit={"horizon": 20}
    )
    different = [
        other(files=files[::-1]),
        other(files=files[:1]),
        other(plant="plants:seated_balance_for"),
        other(arguments={"mass": 1.6}),
        other(configuration=msgspec_replaced),
        other(configuration=Configuration(
            RecordingTable(rate=100.0), configuration.signals, fit={"horizon": 5})),
        other(configuration=Configuration(
            RecordingTable(rate=100.1), configuration.signals, fit={"horizon": 20})),
        other(configuration=Configuration(
            RecordingTable(rate=100.0), configuration.signals, fit={"horizon": 20},
            report=ReportTable("radians"))),
    ]  # fmt: skip
    monkeypatch.setattr("impc.studies.cohort.tasks.versions", lambda: {"numpy": "0"})
    different.append(other())
    assert len({base, *different}) == len(different) + 1
    monkeypatch.undo()
    more = Configuration(
        RecordingTable(rate=100.0), configuration.signals, fit={"horizon": 20, "replicates": 50}
    )
    assert other(configuration=more) == base


def test_the_memory_of_a_fit_knows_all_of_its_problem(tmp_path: Path) -> None:
    def system(growth: float = 1.1, dt: float = 0.1) -> object:
        return control.ss([[growth]], [[1.0]], [[1.0]], 0, dt)

    plant = Plant(system())
    trial = Recording(plant, np.ones((20, 1)))
    family = PlantFamily(lambda values: Plant(system(values[0])), ["growth"], [1.1])

    def problem(**changed: object) -> object:
        made = Problem(plant, Bounds(plant, u_min=-1, u_max=1), 20, (trial,), family=family)
        return replace(made, **changed)

    moved = Recording(plant, np.append(np.ones(19), 1 + 1e-12)[:, None])
    slower = Plant(system(dt=0.2))
    problems = [
        problem(), problem(horizon=5), problem(recordings=(moved,)), problem(plant=slower),
        problem(terminal_set=False), problem(output_scale=np.array([2.0])),
        problem(bounds=Bounds(plant, u_min=-1, u_max=2)),
    ]  # fmt: skip
    found = [open_memory(tmp_path, item, FitSettings()).digest for item in problems]  # type: ignore[arg-type]
    found.append(open_memory(tmp_path, problems[0], FitSettings(), "fit", "x").digest)  # type: ignore[arg-type]
    found.append(open_memory(tmp_path, problems[0], FitSettings(seed=1)).digest)  # type: ignore[arg-type]
    assert len(set(found)) == len(found)
    assert open_memory(tmp_path, problem(), FitSettings()).digest == found[0]  # type: ignore[arg-type]
    Cache(tmp_path / "fit-in-progress").keep("fit", found[1], {"K": [[1.0]]})
    again = open_memory(tmp_path, problem(), FitSettings())  # type: ignore[arg-type]
    assert again.cache.find("fit", again.digest) is None
