"""The `impc` command, from its arguments to its exit status."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from impc.cli.main import main
from impc.control.named_solver import SOLVERS
from impc.errors import SolverError
from impc.model.plant import Plant
from impc.studies.example.cases import distance, run_case

ROOT = Path(__file__).parents[2]


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


@pytest.fixture(scope="module")
def case_b(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path]:
    folder = tmp_path_factory.mktemp("out") / "example"
    return run("example", "--case", "B", "--out", str(folder), "--solver", "daqp"), folder


def test_example_writes_the_files_that_it_names(case_b: tuple[Result, Path]) -> None:
    result, folder = case_b
    assert result.exit_code == 0
    assert result.stderr == ""
    names = {path.name for path in folder.rglob("*")}
    tables = {"methods-B.csv", "tables.xlsx"}
    assert {"report.html", "result.json", "comparison-case-B.svg", *tables} < names
    listed = result.stdout.split("Open ")[1]
    assert all(
        path.name in listed for path in folder.rglob("*") if path.suffix and path.name != ".impc"
    )
    assert max(map(len, result.stdout.split("Open ")[0].splitlines())) <= 100


def test_result_json_is_the_run(case_b: tuple[Result, Path], example_plant: Plant) -> None:
    result = json.loads((case_b[1] / "result.json").read_text(encoding="utf-8"))
    cases = result["cases"]
    assert list(cases) == ["B"]
    assert result["solver"] == "daqp"
    assert "daqp, of CasADi" in (case_b[1] / "report.html").read_text(encoding="utf-8")
    again = run_case(example_plant, "B", solver="daqp")
    assert cases["B"]["truth"]["x"] == again.truth.x.tolist()
    assert cases["B"]["truth"]["u"] == again.truth.u.tolist()
    methods = cases["B"]["methods"]
    assert methods["inverse_lqr_lmi"]["K"] is not None  # feasible
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert methods[name]["distance"] <= 1e-6
    for method in again.methods:
        found, estimate = methods[method.name], method.estimate
        assert estimate.K is not None
        assert found["K"] == [pytest.approx(row) for row in estimate.K.tolist()]
        assert found["misfit"] == pytest.approx(estimate.misfit, abs=1e-9)
        assert found["largest_input"] == {"u": pytest.approx(method.largest_input[0])}
        assert (found["Q"] is None) == (found["R"] is None) == (estimate.weights is None)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (("example", "--case", "D"), "--case"),
        (("example", "--wrong"), "--wrong"),
        (("example", "--solver", "gurobi"), "compiled, daqp, qpoases, ipopt"),
        (("exam",), "exam"),
        (("--wrong",), "--wrong"),
        (("simulate", "seated-balance", "--motor-noise", "nan"), "--motor-noise"),
        (("simulate", "seated-balance", "--amplitude", "1e308"), "--amplitude"),
        (("simulate", "seated-balance", "--mass", "-inf"), "--mass"),
        (("simulate", "seated-balance", "--seed", "9" * 400), "--seed"),
        (("simulate", "cohort", "--duration", "nan"), "--duration"),
        (("simulate", "cohort", "--replicates", str(2**63)), "--replicates"),
        (("key-parameters", "study.toml", "--bound", "nan"), "--bound"),
        (("select", "study.toml", "--workers", "1000000000"), "--workers"),
        (("fit", "a\nb.csv", "--plant", "cursor", "--config", "a.toml"), r"a\nb.csv"),
        (("plan", "\udcff.toml", "--plant", "cursor"), r"\xff.toml"),
    ],
)
def test_bad_arguments_get_one_line(arguments: tuple[str, ...], names: str) -> None:
    result = run(*arguments)
    check_one_line(result, 2)
    assert names in result.stderr


@pytest.mark.parametrize(("more", "count"), [((), 2), (("--sensory-noise",), 3)])
def test_the_filter_of_sensory_noise_compiles_only_on_request(
    monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...], count: int
) -> None:
    compiled: list[str] = []
    for part in ("loop", "bodies", "filter"):
        monkeypatch.setattr(f"impc.cli.warm.compile_{part}", partial(compiled.append, part))
    assert len(run("warm", *more).stdout.splitlines()) == count
    assert compiled == ["loop", "bodies", "filter"][:count]


@pytest.mark.full
@pytest.mark.parametrize("solver", [solver for solver in SOLVERS if solver != "daqp"])
def test_any_solver_finds_the_weights_of_the_example(solver: str, example_plant: Plant) -> None:
    """Case A is at the bound for three samples; case B is solved by daqp above."""
    found = run_case(example_plant, "A", solver=solver)
    assert found.controller.solver == solver
    for name in ("inverse_mpc", "inverse_mpc_reduced"):
        assert distance(found.method(name)) <= 1e-6  # typically 1e-14


@pytest.mark.parametrize("below", ["file", "file/below", "file/far/below"])
def test_a_folder_that_cannot_be_written_gets_one_line_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, below: str
) -> None:
    (tmp_path / "file").write_bytes(b"mine")

    def unwanted(*_: object, **__: object) -> None:
        raise AssertionError("the folder is checked before the work")

    monkeypatch.setattr("impc.cli.example.run_case", unwanted)
    result = run("example", "--out", str(tmp_path / below))
    check_one_line(result, 2)
    assert str(tmp_path / "file") in result.stderr
    assert os.listdir(tmp_path) == ["file"]
    assert (tmp_path / "file").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("error", "status"),
    [(SolverError("HiGHS", "stopped", "try again"), 2), (KeyboardInterrupt(), 130)],
)
def test_a_failure_of_the_work_gets_one_line_and_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, status: int
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("impc.cli.example.run_case", fail)
    check_one_line(run("example", "--out", str(tmp_path / "new" / "folder")), status)
    assert os.listdir(tmp_path) == []


def check_one_line(result: Result, status: int) -> None:
    assert result.exit_code == status
    assert result.stdout == ""
    assert result.stderr.startswith("impc: ")
    assert result.stderr.count("\n") == 1
    assert result.stderr.endswith("\n")
