"""Each message that docs/troubleshooting.md quotes is provoked, and says what the page says."""

from __future__ import annotations

import contextlib
import datetime
import json
import math
import os
import re
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi
import control
import distributed
import numpy as np
import openpyxl
import pytest
import scipy.io
from click.testing import CliRunner
from nptdms import ChannelObject, TdmsWriter

from impc.cli.console import require_consent
from impc.cli.main import main
from impc.cli.plant import find_plant
from impc.control.closed_loop import simulate
from impc.control.controller import Controller
from impc.control.named_solver import require_solver
from impc.control.simulation import require_complete, scenario
from impc.errors import ImpcError
from impc.files import apart
from impc.files.causality import misaligned
from impc.files.configuration import read_configuration
from impc.files.formats import encode_table, read_table
from impc.files.plant_sources import PlantSource, make_plant, plant_source
from impc.files.reading import read_recordings, recording_of
from impc.files.results import read_result
from impc.files.table import Table, make_table
from impc.files.units import si_unit
from impc.inverse.methods import estimate
from impc.inverse.problem import Problem
from impc.inverse.structured_fit import fit_structure
from impc.jit import keep_caches
from impc.model.bounds import Bounds
from impc.model.plant import Plant
from impc.model.recordings import Label, Recording
from impc.model.riccati import solve_lqr
from impc.model.structure import Structure
from impc.model.weights import Weights
from impc.nonlinear.files import (
    OptimalTrial,
    optimal_fit_settings,
    posed,
    read_optimal_trials,
    recorded,
)
from impc.nonlinear.plan import require_solver as require_nlp_solver
from impc.nonlinear.problem import OptimalControlProblem
from impc.output_feedback.fit import fit_person
from impc.output_feedback.observer import Observer, believed_filter
from impc.reporting.writer import owned, require_writable, write_files
from impc.studies import scheduler
from impc.studies.cache import Cache
from impc.studies.cohort.engine import Store, require_same
from impc.studies.cohort.sheet import Sheet, column_values, read_sheet
from impc.studies.cohort.study import checked_name, find_by_pattern, read_study
from impc.studies.effort import Effort
from impc.studies.fit.asked import fit_structures
from impc.studies.fit.settings import FitSettings, fit_settings, require_used
from impc.studies.fit.subject import fit_problem
from impc.studies.pool import Task
from impc.studies.scheduler import Cluster, connected
from impc.studies.selection.fisher import largest_subsets
from plants import seated_balance_plant
from tests.documents.blocks import PAGES
from tests.files.damaged import DAMAGED, PLANT
from tests.files.hostile_files import HOSTILE
from tests.files.samples import csv_text, hdf5_mat, pushed_seat, settings
from tests.files.test_blocks import DATA, book
from tests.files.test_one_step import balanced, fallen, read, stick

PAGE = PAGES["docs/troubleshooting.md"].read_text(encoding="utf-8")
MESSAGES = re.findall(r"\*\*`([^`]+)`\*\*", PAGE)
STUDY = """
[study]
plant = "cursor"
recordings = "{subject}.csv"
[signals.error]
column = "e"
unit = "1"
"""


PLACE, PUSH = casadi.SX.sym("place"), casadi.SX.sym("push")


def with_body(body: Any) -> Plant:
    """A plant of one state with a body of its own."""
    return Plant(control.ss([[0.9]], [[1]], [[1]], 0, 0.1), body=body)


def damaged(name: str) -> Callable[[Path], None]:
    """Read one of the damaged recordings of tests/files."""

    def read(folder: Path) -> None:
        path, text = DAMAGED[name].make(folder)
        (folder / "c.toml").write_text(text)
        configuration = read_configuration(folder / "c.toml")
        source = plant_source(PLANT, configuration.plant)
        plant = make_plant(source, tuple(configuration.signals))
        read_recordings([path], configuration, plant)

    return read


def asked_for(before: str, after: str, **units: str) -> Callable[[Path], None]:
    """Read a sound recording of the seat with one line of its configuration changed."""

    def read(folder: Path) -> None:
        (folder / "a.csv").write_text(csv_text(pushed_seat(600)))
        (folder / "c.toml").write_text(settings((before, after)))
        plant = Plant(seated_balance_plant(), ["command"], units=units or None)
        read_recordings([folder / "a.csv"], read_configuration(folder / "c.toml"), plant)

    return read


def thousands(folder: Path) -> None:
    (folder / "t.csv").write_text("t;x\n0;999\n1;1.000\n")
    read_table(folder / "t.csv")


def old_result(folder: Path) -> None:
    (folder / "result.json").write_text('{"K": [[1.0]], "versions": {}}')
    read_result(folder)


def planned(**changed: Any) -> Callable[[Path], str]:
    """`impc plan` with these keys changed."""
    table = {
        "prices": {"theta1": 6e3},
        "noise": {"theta1": 0.001, "theta2": 0.001},
        "perturbed": ["perturbation"],
        "dwell": [0.5],
        "duration": 5.0,
        "draws": 1,
        "trials": 1,
    } | changed

    def said(folder: Path) -> str:
        text = (
            "[plant]\nmass = 79.7\nheight = 1.66\n[fit]\nu_max = 6.0\n"
            '[fit.structure]\nQ = ["theta1"]\n[plan]\n'
        )
        for name, value in table.items():
            written = json.dumps(value)
            if isinstance(value, dict):
                inner = ", ".join(f"{key} = {item}" for key, item in value.items())
                written = f"{{ {inner} }}"
            text += f"{name} = {written}\n"
        (folder / "plan.toml").write_text(text)
        return command("plan", str(folder / "plan.toml"), "--plant", "seated-balance")

    return said


def cart(growth: float = 1.1) -> Plant:
    return Plant(control.ss([[growth]], [[1]], [[1]], 0, 0.1))


def command(*words: str) -> str:
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    return done.stderr


def short_trial(_: Path) -> None:
    trial = Recording(cart(), np.ones((20, 1)))
    fit_problem(cart(), [trial], FitSettings(settle=10))


def late_push(_: Path) -> str:
    push = np.random.default_rng(2).standard_normal(3000)
    lean = np.convolve(push, np.exp(-np.arange(100) / 30))[: len(push)]
    return misaligned(push, np.roll(lean, -60), 0.01)


TILT, TAP = balanced(1)


def finding(folder: Path, *trial: Any) -> str:
    return read(folder, *trial)[1][0]


def lost_rows(values: Any) -> Any:
    return np.r_[values[:100], np.zeros(20), values[120:300], np.zeros(15), values[315:]]


def lost_samples(values: Any) -> Any:
    lost = np.random.default_rng(0).choice(len(values), 12, replace=False)
    return np.where(np.isin(np.arange(len(values)), lost), 0.0, values)


def stick_settings(folder: Path) -> Any:
    read(folder, TILT, TAP)
    return read_configuration(folder / "a.toml"), Plant(stick(), ["finger"])


def copied_trial(folder: Path) -> None:
    settings = stick_settings(folder)
    shutil.copy(folder / "a.csv", folder / "b.csv")
    read_recordings([folder / "a.csv", folder / "b.csv"], *settings)


def deep_table(folder: Path) -> None:
    (folder / "c.toml").write_text("plant." + "a." * 500 + "a = 1")
    read_configuration(folder / "c.toml")


def trial_twice(folder: Path, other: str = "../data/1.csv") -> None:
    data = folder / "data"
    data.mkdir()
    for name in ("1.csv", "1.xlsx"):
        (data / name).write_text("x")
    (data / "t.csv").write_text(f"file,subject,trial\n1.csv,a,1\n{other},a,2\n")
    (data / "s.toml").write_text(
        '[study]\ntable = "t.csv"\n[signals.x]\ncolumn = "x"\nunit = "1"\n'
    )
    read_study(data / "s.toml")


def late_channel(folder: Path) -> None:
    with TdmsWriter(str(folder / "a.tdms")) as writer:
        for name, offset in (("push", 0.0), ("seat", 0.013)):
            step = {"wf_increment": 0.02, "wf_start_offset": offset}
            writer.write_segment([ChannelObject("g", name, np.arange(99.0), step)])
    read_table(folder / "a.tdms")


def far_start(_: Path) -> None:
    bounds = Bounds(cart(), x_min=-1, x_max=1, u_min=-0.1, u_max=0.1)
    weights = Weights(np.eye(1), 1)
    controller = Controller(cart(), weights, bounds, 3)
    require_complete(controller, simulate(controller, scenario(cart(), x0=[5], steps=3)))


def runaway(growth: float, **settings: float) -> None:
    """A start beyond what the input can stop."""
    plant = cart(growth)
    side = settings.pop("x_max", np.inf)
    bounds = Bounds(plant, u_min=-0.1, u_max=0.1, x_min=-side, x_max=side)
    weights, softening = Weights(np.eye(1), 1), settings.get("softening")
    controller = Controller(plant, weights, bounds, 60, terminal_set=False, softening=softening)
    require_complete(controller, simulate(controller, scenario(plant, x0=[5], steps=400)))


def nothing_holds(_folder: Path) -> None:
    """A gain of nothing, and a plant that grows."""
    plant = cart(1.2)
    law = Controller.from_gain(plant, [[0.0]], Bounds(plant), 5, terminal_set=False)
    require_complete(law, simulate(law, scenario(plant, x0=[5], steps=400)))


def draft_over_a_file(folder: Path) -> str:
    (folder / "a.csv").write_text("t,a\n0,1\n1,2\n")
    return command("inspect", str(folder / "a.csv"), "--out", str(folder / "a.csv"))


def file_for_a_folder(folder: Path) -> None:
    (folder / "out").write_text("")
    require_writable(folder / "out")


def two_runs(folder: Path) -> None:
    with owned(folder, "cohort"), owned(folder, "cohort"):
        pass


def another_study(folder: Path) -> None:
    (folder / "manifest.json").write_text('{"units": {"sub-1": {"digest": "one"}}}')
    store = Store(folder, {"sub-1": "other"})
    store.cache.keep("sub-1/fit", "one", {"K": [[1.0]]})
    require_same(store)


def study_file(folder: Path, text: str) -> Path:
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def unknown_subject(folder: Path) -> None:
    (folder / "s1.csv").write_text("")
    (folder / "who.tsv").write_text("subject\tgroup\ns2\tb\n")
    text = STUDY.replace("recordings", 'participants = "who.tsv"\nrecordings')
    read_study(study_file(folder, text))


def no_model(folder: Path) -> str:
    (folder / "s1.csv").write_text("")
    study = study_file(folder, STUDY)
    return command("select", str(study), "--out", str(folder / "out"))


def another_command(folder: Path) -> None:
    with owned(folder / "out", "fit"):
        write_files(folder / "out", {"report.html": b""})
    with owned(folder / "out", "compare"):
        pass


def results_without_a_list(folder: Path) -> None:
    (folder / "report.html").write_text("")
    with owned(folder, "fit"):
        pass


def file_of_ones_own(folder: Path) -> None:
    (folder / "gain.png").write_text("")
    with owned(folder, "fit"):
        write_files(folder, {"gain.png": b""})


def no_room(folder: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit[1]))
    try:
        Cache(folder / "units").keep("fit", "", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)


def folder_for_a_file(folder: Path) -> None:
    (folder / "cohort.log").mkdir()
    Store(folder, {}).log("run")


def own_plant(folder: Path) -> Path:
    (folder / "s1.csv").write_text("")
    return study_file(folder, STUDY.replace('"cursor"', '"mine:plant"'))


def sheet_of(folder: Path, text: str) -> Sheet:
    (folder / "t.csv").write_text(text)
    return read_sheet(folder / "t.csv")


def connect(address: str) -> None:
    with connected(Cluster(address)):
        pass


def no_scheduler(_: Path) -> None:
    connect("tcp://127.0.0.1:9")


def lost_scheduler(_: Path) -> None:
    make: Any = distributed.LocalCluster
    with make(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=60
    ) as found, connected(Cluster(found.scheduler_address)) as pool:  # fmt: skip
        pool.submit(1, [Task("long", "", time.sleep, (0.5,))])
        found.close()
        pool.take()


def everything_recorded(_: Path) -> None:
    source = plant_source("plants:cursor_plant", {})
    make_plant(source, source.make().input_labels)


def workbook(*rows: Sequence[Any]) -> Callable[[Path], Table]:
    def read(folder: Path) -> Table:
        made = openpyxl.Workbook()
        for row in rows:
            made.active.append(row)
        made.save(folder / "t.xlsx")
        return read_table(folder / "t.xlsx")

    return read


def locked_workbook(folder: Path) -> None:
    """As Excel encrypts: a compound file, whatever its ending."""
    (folder / "t.xlsx").write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(504))
    read_table(folder / "t.xlsx")


def a_pipe(folder: Path) -> None:
    os.mkfifo(folder / "t.csv")
    read_table(folder / "t.csv")


def reader_that(ends: str) -> Callable[[Path], None]:
    """Read by a process that ends so."""

    def read(folder: Path) -> None:
        hdf5_mat(folder / "t.mat", {"x": np.arange(9.0)})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(apart, "_children", {})
            patch.setattr(apart, "_START", f"import os, signal; {ends}")
            read_table(folder / "t.mat")

    return read


def endless_pattern(_: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(apart, "_SECONDS", 1)
        apart.match_apart("recording.pattern", "(a+)+x", "a" * 60)


def clock_in_microseconds(folder: Path) -> None:
    columns = pushed_seat()
    table = make_table("t.csv", {**columns, "time": 1e6 * columns["time"]})
    read_seat(folder, table)


def value_of_a_fault(folder: Path) -> None:
    columns = pushed_seat()
    read_seat(folder, make_table("t.csv", {**columns, "seat": 1e300 * columns["seat"]}))


def read_seat(folder: Path, table: Table) -> None:
    (folder / "c.toml").write_text(settings())
    plant = make_plant(plant_source(PLANT, {}), ("perturbation",))
    recording_of(table, read_configuration(folder / "c.toml"), plant)


def saved_plant(**changed: object) -> Callable[[Path], None]:
    """Make a plant from a file in which something is wrong."""

    def read(folder: Path) -> None:
        matrices: dict[str, object] = {"A": [[0.5]], "B": [[1.0]], "C": [[1.0]], "dt": 0.1}
        scipy.io.savemat(folder / "plant.mat", matrices | changed)
        make_plant(plant_source(str(folder / "plant.mat"), {}), ())

    return read


def of_fit(table: dict[str, Any]) -> Callable[[Path], object]:
    return lambda _: fit_settings(table)


def module_of_an_installed_name(folder: Path) -> None:
    (folder / "control.py").write_text("def stick(): pass")
    with contextlib.chdir(folder):
        plant_source("control:stick", {})


def caches_without_a_home(folder: Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
            patch.setenv(name, f"{__file__}/none")
        for name in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
            patch.setenv(name, "")  # so that it is put back afterwards
            patch.delenv(name)
        return f"impc: note: {keep_caches()}"


def running_away() -> Plant:
    """State p grows by itself, q does not and knows nothing of it."""
    system = control.ss(
        np.diag([3.0, 0.5]), [[1.0, 1.0], [0.0, 0.0]], [[1.0, 0.0]], 0, 1, states=["p", "q"],
        inputs=["u", "push"],
    )  # fmt: skip
    return Plant(system, ["u"])


def held_by_nobody(_: Path) -> None:
    """A push far beyond the limit: whatever the prices, the plant runs away."""
    plant = running_away()
    structure = Structure(plant, ["p"])
    limits = Bounds(plant, u_min=-1, u_max=1)
    law = Controller(plant, structure.weights(np.zeros(1)), limits, 3)
    trial = Recording(plant, np.zeros((900, 1)), np.full(900, 50.0))
    fit_structure(Problem(plant, limits, 3, [trial]), structure, law.K, law.S)


def too_many_subsets(_: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("impc.studies.selection.fisher._MOST", 1000)
        largest_subsets([np.eye(40)], 2.0)


def large_request(seconds: float, gigabytes: float) -> Callable[[Path], object]:
    return lambda _: require_consent(Effort(seconds, gigabytes), given=False)


def format_of_an_extra(_: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "nptdms", None)
        encode_table(".tdms", make_table("t", {"x": np.arange(9.0)}))


#: Message -> what provokes it: raises the error, or returns the text.


def unused_setting(_: Path) -> None:
    require_used(fit_settings({"profiles": ["K.u.x"]}), (), "compare")


def without_daqp(_: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(casadi, "has_conic", lambda _: False)
        require_solver("daqp")


def own_problem(**changes: Any) -> OptimalControlProblem:
    """A point with a limited force, one entry of it changed."""
    x, u, price, w = (casadi.SX.sym(name) for name in ("x", "u", "price", "w"))
    parameters = {"price": price} | ({"w": w} if "w" in changes else {})
    given = {
        "next_state": x + 0.1 * u, "stage_cost": price * x**2 + u**2, "horizon": 4,
        "constraints": {"force": casadi.vertcat(u - 1, -u - 1), "x": x - 1},
    }  # fmt: skip
    given |= {name: value(x, u, price) for name, value in changes.items() if callable(value)}
    return OptimalControlProblem(x, u, parameters, **given)  # type: ignore[arg-type]


def own_system(update: Callable[..., Any]) -> Callable[[Path], object]:
    system = control.nlsys(update, states=["x"], inputs=["u"], dt=0.1)
    return lambda _: own_problem(next_state=lambda x, u, p: system)


def without_fatrop(_: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(casadi, "has_nlpsol", lambda _: False)
        require_nlp_solver("fatrop")


def signal_of_no_problem(folder: Path) -> None:
    (folder / "own.toml").write_text('[signals.y]\ncolumn = "y"\nunit = "m"\n', encoding="utf-8")
    read_optimal_trials([], read_configuration(folder / "own.toml"), own_problem())


def unknown_first_value(_: Path) -> None:
    nothing = np.full((5, 1), np.nan)
    trial = OptimalTrial(Label(), nothing, np.zeros((4, 1)), np.zeros((4, 0)), 0.1, ())
    recorded(own_problem(), trial, optimal_fit_settings({}))


def integrator() -> Plant:
    """A cart: where it is cannot be told from how fast it goes."""
    system = control.ss([[1, 0.1], [0, 0.9]], [[0], [0.1]], [[1, 0]], 0, 0.1, states=["x", "v"])
    return Plant(system)


def nobody_estimates(_: Path) -> None:
    plant = integrator()
    law = Controller(plant, Weights(np.eye(2), 1), Bounds(plant), 3, terminal_set=False)
    outputs = law.simulate([1, 0], 60).x[:, :1]
    noisy = outputs + 0.01 * np.random.default_rng(1).standard_normal(outputs.shape)
    problem = Problem(plant, Bounds(plant), 3, [Recording(plant, noisy, x0=[1, 0])],
                      terminal_set=False)  # fmt: skip
    fit_person(estimate(problem), Observer(plant, ["v"], motor=1.0, sensory=1.0))


def beyond_feasibility(_: Path) -> str:
    plant = Plant(control.ss([[2.0]], [[1]], [[1]], 0, 1))
    law = Controller(plant, Weights(1, 1), Bounds(plant, u_min=-1, u_max=1), 3)
    with pytest.warns(UserWarning, match="NaN") as told:
        law.simulate([2.0], steps=5)
    return str(told[0].message)


PROVOKED: dict[str, Callable[[Path], object]] = {
    "does not exist; check the path": damaged("missing file"),
    "has the ending '...', and not ...; export": damaged("old excel workbook"),
    "ends in ... and is a zip archive or an Excel workbook": damaged("excel workbook called csv"),
    "ends in ... and is an Excel workbook that is old or locked by a password": locked_workbook,
    "cannot be written as .ods": lambda _: encode_table(
        ".ods", make_table("t", {"x": np.arange(2.0)})
    ),
    "is too large once it is unpacked (...)": lambda folder: read_table(
        HOSTILE["zip bomb"].make(folder)
    ),
    "has no rows of numbers in the first ... rows of a sheet": workbook(["a"], ["b"]),
    "column '...' has ... and ...; save it as numbers, all of one kind": workbook(
        ["x", "y"], [1, 2], [2, datetime.date(2026, 1, 1)]
    ),
    "has no rows of numbers divided by": damaged("csv of a header alone"),
    "the header names ... columns, and the rows below have ... values": damaged(
        "decimal commas between commas"
    ),
    "column '...' has text in ... of ... rows": damaged("text in a column"),
    "the file ends in the middle of a row": damaged("truncated csv"),
    "is a MATLAB table; save a struct of vectors": damaged("table object"),
    "is no ordinary file": a_pipe,
    "takes more than ... GB to read": reader_that("os.kill(os.getpid(), signal.SIGKILL)"),
    "takes longer than ... s to read": reader_that("os.kill(os.getpid(), signal.SIGXCPU)"),
    "ends the process that reads it (...)": reader_that("os.abort()"),
    "cannot be matched with '...' in ... s": endless_pattern,
    "has a sample every ... s, and the plant one every ... s": clock_in_microseconds,
    "which is no measurement": value_of_a_fault,
    "has a complex matrix ...": saved_plant(A=np.array([[0.5 + 1j]])),
    "names ... states and has ...": saved_plant(states=np.array(["x", "v"], dtype=object)),
    "is damaged and cannot be read (...)": damaged("truncated mat"),
    "is not TOML (...)": damaged("configuration that is no toml"),
    "is not known; did you mean ...": damaged("misspelled key"),
    "[fit] ...: is not used by impc ...; take the line out, or use impc fit": lambda _: (
        require_used(fit_settings({"profiles": ["K.u.x"]}), (), "compare")
    ),
    "sample ...: ...; what follows is NaN": beyond_feasibility,
    "method: got ...; choose one of ...": lambda _: fit_settings({"methods": ["best"]}),
    "solver: got ...; choose one of ...": lambda _: fit_settings({"solver": "gurobi"}),
    "solver: ... is not part of the CasADi that is installed": without_daqp,
    "[fit] ...: is not a setting; did you mean ...": lambda _: fit_settings({"horzon": 20}),
    "... has the symbol ...; which is neither a state, an input, a disturbance nor a parameter": (
        lambda _: own_problem(stage_cost=lambda x, u, p: p * x**2 + casadi.SX.sym("w") * u**2)
    ),
    "parameter ...: is in no expression; take it out": lambda _: own_problem(w=1),
    "next_state: is a system whose function takes no symbols (...)": own_system(
        lambda t, x, u, params: x + u if x[0] > 0 else x
    ),
    "next_state: is a system whose function is another on symbols than on numbers": own_system(
        lambda t, x, u, params: [math.sin(x[0]) + u[0]]
    ),
    "... is not finite at sample ... of the start": lambda _: own_problem(
        stage_cost=lambda x, u, p: p * casadi.log(x) ** 2 + u**2
    ).plan({"price": 1.0}, [-1.0]),
    "constraint ...: no plan was found that keeps it at sample ...": lambda _: own_problem().plan(
        {"price": 1.0}, [2.0]
    ),
    "plan: the cost has no minimum in the inputs of sample ...": lambda _: own_problem(
        stage_cost=lambda x, u, p: p * x, constraints=lambda x, u, p: None
    ).plan({"price": 1.0}, [0.5]),
    "solver: ... is not in this CasADi; choose ipopt": without_fatrop,
    "[fit.parameters] ...: is missing; give it start or known": lambda _: posed(
        own_problem(), optimal_fit_settings({})
    ),
    "[fit.x0] ...: is missing, and was not recorded": unknown_first_value,
    "is no signal of the problem": signal_of_no_problem,
    "states: has ... samples; give ...": lambda _: own_problem().recorded_plan(np.zeros((3, 1))),
    "is an optimal control problem; impc fit takes one, this does not": lambda _: make_plant(
        PlantSource("mine:problem", own_problem, {}), ()
    ),
    "[fit.structure] ...: is not a setting; see docs/fitting.md": lambda _: fit_settings(
        {"structure": {"q": "diagonal"}}
    ),
    "[fit.observer] ...: is not a setting; see docs/fitting.md": lambda _: fit_settings(
        {"observer": {"senses": ["theta1"]}}
    ),
    "walk: is given, but every state is seen; say what is sensed": lambda _: Observer(
        integrator(), walk=1.0
    ),
    "sensory: has a zero; give each sensed signal some noise": lambda _: Observer(
        integrator(), ["x"], motor=1.0
    ),
    "filter: has no stationary gain: ...; let another signal be sensed, or give some motor or"
    " process noise": lambda _: believed_filter(
        integrator(), Observer(integrator(), ["v"], motor=1.0, sensory=1.0)
    ),
    "person: no start has a likelihood: ...; give other levels": nobody_estimates,
    "[fit] structures: has '...' twice; name each by itself": lambda _: fit_structures(
        running_away(), fit_settings({"structure": {}, "structures": [{}]})
    ),
    "[plan] prices: lacks '...'; presume a price for each feature": planned(prices={}),
    "[plan] perturbed: names no input of the plant; known: ...": planned(perturbed=[]),
    "[plan]: the person falls in ... % of the trials or more, whatever the perturbation": planned(
        amplitude=[90.0]
    ),
    "is still '?'; fill in the column's unit": damaged("unit not filled in"),
    "is still '?'; fill in its name in the file": asked_for('column = "trunk"', 'column = "?"'),
    "is still '?'; fill it in, or take the line out": lambda _: fit_settings({"u_max": "?"}),
    "is '...', and the plant has ... in ...; correct the unit or the column": asked_for(
        'column = "trunk"\nunit = "deg"', 'column = "trunk"\nunit = "mV"'
    ),
    "plant.units ...: is '...'; make the plant in SI units": asked_for("", "", theta1="deg"),
    "plant.units: names ... with ...": lambda _: Plant(seated_balance_plant(), units={"x": "m"}),
    "is of another version of impc (schema ..., not ...)": old_result,
    "unit '...' is not known": damaged("unknown unit"),
    "is missing: the plant's outputs are ...": damaged("output without a column"),
    "is no output or disturbance of the plant": damaged("signal that the plant lacks"),
    "column '...': is not in the file; ...": damaged("absent column"),
    "tells no clock and no rate": damaged("unknown rate"),
    "is in '...' by the configuration and in '...' by the file": damaged(
        "units swapped against the file"
    ),
    "more than half a turn": damaged("degrees called radians"),
    "radians taken for degrees?": damaged("radians called degrees"),
    "is beyond its stop of ...": damaged("angle beyond the stop"),
    "samples are missing or not finite": damaged("missing samples"),
    "has ... gaps, the first at ...": damaged("gap in the clock"),
    "is repeated ... times": damaged("duplicated time stamps"),
    "runs backward ... times": damaged("clock that runs backward"),
    "is constant at ...": damaged("constant channel"),
    "is clipped at ...": damaged("clipped channel"),
    "samples at the plant's rate, ... are needed": damaged("too few samples"),
    "serve to find where it starts": short_trial,
    "comes before it: their correlation is ...": late_push,
    "the subject fell at ...": lambda folder: read(folder, fallen(TILT, 8.0), TAP),
    "stands still ... times, ... samples in all": lambda folder: finding(
        folder, lost_rows(TILT), TAP
    ),
    "jumps to ... and back ... times": lambda folder: finding(folder, lost_samples(TILT), TAP),
    "is off by about ...": lambda folder: finding(folder, TILT + 1, TAP),
    "drifts by about ...": lambda folder: finding(folder, TILT + np.linspace(0, 2, 600), TAP),
    "acts ... than its rows say": lambda folder: finding(folder, TILT, np.roll(TAP, 1)),
    "is given twice": lambda folder: read_recordings([folder] * 2, *stick_settings(folder)),
    "is a copy of ..., byte for byte": copied_trial,
    "can be read in two ways": lambda _: si_unit("Grad"),
    "a capital M is mega, G giga": lambda _: si_unit("Mm"),
    "has no sheet '...'": lambda folder: read_table(book(folder / "a.xlsx", a=DATA), sheet="b"),
    "is nested too deep": deep_table,
    "has nothing between {...}{...}": lambda folder: find_by_pattern(
        "s", folder, "{subject}{trial}"
    ),
    "names the same file twice": trial_twice,
    "the same trial in two formats": lambda folder: trial_twice(folder, "1.xlsx"),
    "begins at another time than": late_channel,
    "cannot be imported (...)": lambda _: plant_source("nowhere:stick", {}),
    "refuses its arguments (...)": lambda _: make_plant(
        plant_source("plants:cursor_plant", {"size": 3}), ()
    ),
    "rename yours: an installed module has its name": module_of_an_installed_name,
    "ends in ... (...); correct the function, or what it is given": lambda _: make_plant(
        PlantSource("mine:stick", lambda: sys.exit(0), {}), ()
    ),
    "[fit] ...: got ...; give at most ...": of_fit({"horizon": 2**63}),
    "names ... twice; name each once": of_fit({"free": ["mass", "mass"]}),
    "is a ... that no result can keep": lambda _: find_plant("cursor", {"sample_time": 2**64}),
    "would need ... GB of memory, more than this machine has": large_request(0, 1e9),
    "more than ... subsets keep a variance of ...": too_many_subsets,
    "this request: would take about ... hours; ...; or say --yes": large_request(1e9, 0),
    "impc: note: caches are kept in ...": caches_without_a_home,
    "is continuous, a discrete one is needed": lambda _: Plant(
        control.ss([[-1]], [[1]], [[1]], 0)
    ).require_discrete(),
    "plant.body: expected a casadi.Function, got ...": lambda _: with_body(3.0),
    "plant.body: takes ... and gives ...": lambda _: with_body(
        casadi.Function("f", [PLACE], [PLACE])
    ),
    "plant.body: has the operation ...; write it without": lambda _: with_body(
        casadi.Function("f", [PLACE, PUSH], [0.9 * PLACE + PUSH * casadi.erf(PLACE)])
    ),
    "plant.body: has another linearisation at rest than A and B": lambda _: with_body(
        casadi.Function("f", [PLACE, PUSH], [PLACE + PUSH])
    ),
    "plant.D: is not zero": lambda _: Plant(control.ss([[0.5]], [[1]], [[1]], 1, 0.1)),
    "is not stabilisable: no input reaches the mode ...": lambda _: Plant(
        control.ss([[2, 0], [0, 0.5]], [[0], [1]], np.eye(2), 0, 0.1)
    ),
    "all its inputs are recorded": everything_recorded,
    "feature '...': expected ...; combine ... with numbers, + and -": lambda _: Structure(
        running_away(), ["sin(x)"]
    ),
    "different prices of ... make the same weights; leave one out": lambda _: Structure(
        running_away(), ["p", "2 p"]
    ),
    "leaves the mode ..., which does not decay by itself, without a price; price one of ...": (
        lambda _: Structure(running_away(), ["q"])
    ),
    "none of its regulators can be simulated on the recordings": held_by_nobody,
    "have no stabilising Riccati solution (...)": lambda _: solve_lqr(
        cart(1.0), Weights(np.zeros((1, 1)), 1)
    ),
    "no input sequence keeps the bound ...": far_start,
    "the input cannot be determined in double precision": lambda _: runaway(
        2.0, x_max=1.0, softening=50.0
    ),
    "the state left every reasonable range": nothing_holds,
    "exclude the origin for ...": lambda _: Bounds(cart(), u_min=1, u_max=2),
    "exists already; give another name, or remove it": draft_over_a_file,
    "... is a file; give another folder": file_for_a_folder,
    "another run is writing to it": two_runs,
    "was fitted to other recordings or with other settings, plant or versions": another_study,
    "holds results of impc ...; give another folder": another_command,
    "holds ... of another version or of your own": results_without_a_list,
    "is not of an earlier run of this command": file_of_ones_own,
    "cannot be written (...); make room and start again": no_room,
    "cannot be written (...); move what is in its place, or give another folder": (
        folder_for_a_file
    ),
    "names code that would be run, ...": lambda folder: command(
        "cohort", str(own_plant(folder)), "--out", str(folder / "out")
    ),
    "has ... in it; use letters, digits, spaces and . + - _": lambda _: checked_name(
        "t.csv", "subject", "a/b"
    ),
    "row ... has ... cells, the head ...": lambda folder: sheet_of(
        folder, "subject,mass\n1,70,5\n"
    ),
    "which may be a thousand": thousands,
    "which may be thousands; write it with a decimal point": lambda folder: column_values(
        sheet_of(folder, "subject;mass\n1;1,234\n"), "mass"
    ),
    "was lost while tasks were out": lost_scheduler,
    "needs --tls-..., ...; give the three files": lambda _: connect("tls://127.0.0.1:9"),
    "matches no file; check the path": lambda folder: read_study(study_file(folder, STUDY)),
    "is not in ...; add a row": unknown_subject,
    "study.model: is missing": no_model,
    "needs the package ...; install it: pip install 'impc[...]'": format_of_an_extra,
    "scheduler ...: does not answer (...)": no_scheduler,
}


def test_every_message_of_the_page_is_provoked() -> None:
    assert len(MESSAGES) == len(set(MESSAGES))
    assert set(MESSAGES) == set(PROVOKED)


@pytest.mark.parametrize(
    "message",
    [  # The filter of a person takes two minutes to compile.
        pytest.param(one, marks=pytest.mark.full if one.startswith("person: ") else [])
        for one in PROVOKED
    ],
)
def test_the_message_is_what_is_said(
    message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scheduler, "_PATIENCE", "1s")
    try:
        said = str(PROVOKED[message](tmp_path))
    except ImpcError as error:
        said = str(error)
    pattern = ".*".join(re.escape(part) for part in message.split("..."))
    assert re.search(pattern, said), said
    assert "\n" not in said.strip()
