"""The TOML configuration: what is read, and the errors of invalid files."""

from __future__ import annotations

import json
import pickle
import tracemalloc
from pathlib import Path

import pytest

from impc.errors import InputError
from impc.files.configuration import RecordingTable, SignalTable, read_configuration
from tests.files.samples import settings

WHOLE = """
[recording]
time = "t"
time_unit = "ms"
subject = 7
visit = "1"
condition = "eyes open"
trial = 3
fill_gaps = 0.1
start = 0
stop = 30

[signals.theta1]
column = "seat angle"
unit = "deg"
limit = 12
offset = 0.5
sign = -1

[plant]
sample_time = 0.01
[plant.nested]
mass = 70

[fit]
horizon = 20
free = ["J2"]

[report]
angles = "radians"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "subject.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_key(tmp_path: Path) -> None:
    configuration = read_configuration(written(tmp_path, WHOLE))
    assert configuration.recording == RecordingTable(
        time="t",
        time_unit="ms",
        subject="7",
        visit="1",
        condition="eyes open",
        trial="3",
        fill_gaps=0.1,
        start=0.0,
        stop=30.0,
    )
    assert configuration.signals == {"theta1": SignalTable("seat angle", "deg", 12.0, 0.5, -1)}
    assert configuration.plant == {"sample_time": 0.01, "nested": {"mass": 70}}
    assert configuration.fit == {"horizon": 20, "free": ["J2"]}
    assert configuration.report.angles == "radians"
    assert read_configuration(written(tmp_path, settings())).report.angles == "degrees"
    with pytest.raises(AttributeError):
        configuration.recording.rate = 5.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ("[recording]", '[report]\nangles = "grad"\n[recording]', "report.angles: Invalid enum"),
        ("[recording]", "[recordings]", "recordings: is not known; did you mean recording?"),
        ('subject = "S01"', "subjekt = 1", "recording.subjekt: is not known; did you mean subject"),
        ('time = "time"', "rate = 0.0", "recording.rate: got 0.0; give more than 0"),
        ('time = "time"', "rate = nan", "recording.rate: got nan"),
        ('time = "time"', 'rate = "1000"', "recording.rate: Expected 'float | null', got 'str'"),
        ('time = "time"', 'time = "time"\nrate = 10.0', "recording.rate: is given in addition"),
        ('time = "time"', "fill_gaps = -1.0", "recording.fill_gaps: got -1.0; give at least 0"),
        ('time = "time"', "start = inf", "recording.start: got inf"),
        ('time = "time"', "start = 3.0\nstop = 2.0", "recording.stop: is 2 s, start 3 s"),
        ('time = "time"', 'time_unit = "mm"', "recording.time_unit: 'mm' is not a unit of time"),
        ('time = "time"', "time = 1", "recording.time: Expected 'str | null', got 'int'"),
        ('time = "time"', "pattern = '(.+)'", "recording.pattern: has the named groups []"),
        (
            'time = "time"',
            "pattern = '(?P<name>.+)'",
            "recording.pattern: has the named groups ['name']",
        ),
        ('time = "time"', "pattern = '(?P<subject>.+)'", "recording.subject: is given here and in"),
        ("limit = 12.0", "limit = -12.0", "signals.theta1.limit: got -12.0; give more than 0"),
        ("limit = 12.0", "offset = nan", "signals.theta1.offset: got nan"),
        ("limit = 12.0", "sign = 2", "signals.theta1.sign: Invalid enum value 2"),
        ("limit = 12.0", "sign = 1.0", "signals.theta1.sign: Expected 'int', got 'float'"),
        ('column = "seat"', "", "signals.theta1: lacks 'column'"),
        ('unit = "Nm"', 'unit = "g"', "signals.perturbation.unit: unit 'g' is ambiguous"),
        ("[signals.theta1]", "[signals.theta1]\n[signals.theta1]", "is not TOML"),
        ("[signals.theta1]", '[signals."b. ü"]\na = 1\n[signals.theta1]', "signals.b. ü.a: is not"),
        ("[recording]", "plant = 3\n[recording]", "plant: is not a table"),
        ("[recording]", "signals.x = 3\n[recording]", "signals.x: is not a table"),
        ("[recording]", "subject.files = 'a.csv'\n[recording]", "subject.files: Expected 'array'"),
        ("[recording]", "subject.file = 'a.csv'\n[recording]", "subject.file: is not known"),
    ],
)
def test_one_line_with_the_path_of_the_fault(
    tmp_path: Path, old: str, new: str, phrase: str
) -> None:
    path = written(tmp_path, settings((old, new)))
    with pytest.raises(InputError) as caught:
        read_configuration(path)
    assert phrase in str(caught.value)
    assert "\n" not in str(caught.value)
    error = pickle.loads(pickle.dumps(caught.value))
    assert (error.file, str(error)) == (str(path), str(caught.value))
    assert error.subject == (f"{path}: {'.'.join(error.place)}" if error.place else str(path))
    assert bool(error.place) == (phrase != "is not TOML")


def test_recordings_of_a_subject_are_in_its_folder(tmp_path: Path) -> None:
    """On every system, whichever the file was written on."""

    def named(name: str) -> tuple[str, ...]:
        text = f"[subject]\nfiles = {json.dumps([name])}\n"
        return read_configuration(written(tmp_path, text + settings())).subject.files

    assert named("day 1/b..xlsx") == ("day 1/b..xlsx",)
    for name in ("../a.csv", "a/../../b.csv", "..\\a.csv", "/a.csv", "\\a.csv", "C:\\a.csv",
                 "C:a.csv", "\\\\host\\share\\a.csv", "//host/share/a.csv", "", ".", "..",
                 "a\n.csv", "\0"):  # fmt: skip
        with pytest.raises(InputError, match=r"subject\.files: .* is no path below its folder"):
            named(name)


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 16_000) + " = 1",
        "[plant]\n" + ".".join(["a"] * 500) + " = 1",
        "[" + ".".join(['"a b"'] * 9_000) + "]\nb = 1",
        "x = {" + " . ".join(["'a'"] * 9_000) + " = 1}",
        "plant = " + "{a = " * 100 + "1" + "}" * 100,
        "[plant]\na = " + "[" * 100 + "]" * 100,
    ],
)
def test_what_is_nested_deep_takes_no_memory(tmp_path: Path, text: str) -> None:
    """tomllib takes 1 GB for the first of them."""
    path = written(tmp_path, text)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="nested too deep"):
            read_configuration(path)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_files_that_are_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_configuration(tmp_path / "none.toml")
    with pytest.raises(InputError, match="is a folder"):
        read_configuration(tmp_path)
    with pytest.raises(InputError, match="contains no signal"):
        read_configuration(written(tmp_path, "[recording]\nrate = 5.0\n"))
    with pytest.raises(InputError, match="is not a table"):
        read_configuration(written(tmp_path, "signals.x = 3\n"))
    with pytest.raises(InputError, match="nested too deep"):
        read_configuration(written(tmp_path, "x = " + "[" * 5000 + "]" * 5000))
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not UTF-8"):
        read_configuration(tmp_path / "binary.toml")
    with (tmp_path / "large.toml").open("wb") as file:
        file.truncate(2_000_000)
    with pytest.raises(InputError, match=r"; at most .* are read"):
        read_configuration(tmp_path / "large.toml")
