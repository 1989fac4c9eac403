"""Reading a study: patterns, tables, BIDS names, participants, and error messages."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import impc
from impc.files.plant_sources import PlantSource, plant_source
from impc.studies.cohort.study import Study, read_study
from impc.studies.cohort.tasks import study_tasks, unused_columns

SIGNALS = """
[signals.position]
column = "position"
unit = "m"
"""


def study(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(f"[study]\nplant = 'cursor'\n{text}\n{SIGNALS}")
    return path


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


def with_people(folder: Path, text: str, *subjects: str) -> Path:
    """A study of one trial a subject, with a table of participants."""
    touch(folder, *(f"s{subject}.csv" for subject in subjects or "1"))
    (folder / "p.csv").write_text(text, encoding="utf-8")
    return study(folder, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')


#: Files, [study], and the files of each unit that is found.
FINDS: list[tuple[list[str], str, dict[str, list[str]]]] = [
    (  # 2 before 10
        ["d/s1/v1_EO_2.csv", "d/s1/v1_EO_10.csv", "d/s2/v1_EC_1.csv", "d/other.csv"],
        'recordings = "d/s{subject}/v{visit}_{condition}_{trial}.csv"',
        {"sub-1_ses-1_task-EO": ["v1_EO_2.csv", "v1_EO_10.csv"],
         "sub-2_ses-1_task-EC": ["v1_EC_1.csv"]},
    ),
    (  # a name may come twice and must agree
        ["sub-1/sub-1_a.csv", "sub-1/sub-2_a.csv"],
        'recordings = "sub-{subject}/sub-{subject}_a.csv"',
        {"sub-1": ["sub-1_a.csv"]},
    ),
    (  # any format
        ["P1_1.csv", "P1_2.xlsx", "P2_1.XLSX", "P2_1.doc"], 'recordings = "{subject}_{trial}.*"',
        {"sub-P1": ["P1_1.csv", "P1_2.xlsx"], "sub-P2": ["P2_1.XLSX"]},
    ),
    (["d[1]/s1.csv", "d1/s2.csv"], 'recordings = "FOLDER/d[1]/s{subject}.csv"',
     {"sub-1": ["s1.csv"]}),
    (
        ["sub-01/ses-1/sub-01_ses-1_task-EO_run-1_motion.csv",
         "sub-01/ses-1/sub-01_ses-1_task-EO_run-2_motion.csv",
         "sub-01/ses-1/sub-01_ses-1_task-EO_run-2_motion.json",
         "sub-01/ses-2/sub-01_ses-2_task-EO_run-1_motion.csv",
         "sub-01/ses-2/.impc-k3/new/sub-01_ses-2_task-EO_run-2_motion.csv"],
        'bids = "."',
        {"sub-01_ses-1_task-EO": ["sub-01_ses-1_task-EO_run-1_motion.csv",
                                  "sub-01_ses-1_task-EO_run-2_motion.csv"],
         "sub-01_ses-2_task-EO": ["sub-01_ses-2_task-EO_run-1_motion.csv"]},
    ),
    (
        [f"sub-01_task-x_run-{run}" for run in
         ("1.csv", "2.CSV", "3.tsv", "4.txt", "5.xlsx", "6.XLSX", "7.ods", "8.mat", "9.sto")],
        'bids = "."',
        {"sub-01_task-x": [f"sub-01_task-x_run-{run}" for run in
         ("1.csv", "2.CSV", "3.tsv", "4.txt", "5.xlsx", "6.XLSX", "7.ods", "8.mat", "9.sto")]},
    ),
]  # fmt: skip


@pytest.mark.parametrize(("files", "text", "units"), FINDS)
def test_units(tmp_path: Path, files: list[str], text: str, units: dict[str, list[str]]) -> None:
    touch(tmp_path, *files)
    found = read_study(study(tmp_path, text.replace("FOLDER", tmp_path.as_posix()))).units
    assert {unit.name: [file.name for file in unit.files] for unit in found} == units


def test_a_table_and_participants(tmp_path: Path) -> None:
    """Accents composed and not are one name, and the folder's name has none."""
    rows = "file\tsubject\ttrial\nx.csv\tRen\u00e9\t1\ny.csv\tRene\u0301\t2\n"
    (tmp_path / "t.tsv").write_text(rows)
    (tmp_path / "p.tsv").write_text("participant_id\tgroup\tmass\tsex\nsub-René\told\t70\tmale\n")
    (unit,) = read_study(study(tmp_path, 'table = "t.tsv"\nparticipants = "p.tsv"')).units
    assert (unit.subject, unit.group, len(unit.files)) == ("Ren\u00e9", "old", 2)
    assert unit.person == {"mass": 70.0, "sex": "male"}
    assert unit.name.isascii()


#: [study], rows of the table t.csv, and a part of the message.
FAULTS = [
    ("", "", "exactly one"),
    ('recordings = "{subject}.csv"\nbids = "."', "", "exactly one"),
    ('recordings = "{person}.csv"', "", "names person"),
    ('recordings = "{trial}.csv"', "", "names no subject"),
    ("recordings = '{subject!r}.csv'", "", "names no subject"),
    ('recordings = "none-{subject}.csv"', "", "matches no file"),
    ("recordings = '/nowhere/{subject}.csv'", "", "matches no file"),
    ("recordings = '[{subject}.csv'", "", "matches no file"),
    ("recordings = '**/{subject}.csv'", "", "invalid pattern"),
    ("recordings = '{subject}{trial}{visit}.csv'", "", "a separator between two"),
    ('recordings = "{subject}.*"', "", "the same trial in two formats"),
    ('recordings = "{subject}.txt"', "", "two units"),
    ('recordings = "{subject}.csv"\nparticipants = "missing.csv"', "", "does not exist"),
    ('recordings = "{subject}.csv"\nparticipants = "t.csv"', "subject\nother\n", "not in t.csv"),
    ('recordings = "{subject}.csv"\nspeed = 1', "", "unknown field"),
    ("recordings = ''", "", "study.recordings: is empty"),
    ('recordings = "{subject}\\u0000.csv"', "", "study.recordings: is empty"),
    ("bids = ' '", "", "study.bids: is empty"),
    ("table = '.'", "", "is a folder"),
    ("table = 't.csv'", "", "is empty"),
    *(("table = 't.csv'", rows, match) for rows, match in (
        ("name,group\nother,a\n", "without file or subject"),
        ("file,subject\n1.csv,\n", "without file or subject"),
        ("file,subject\n1.csv,a\n1.csv,b\n", "is given twice"),
        ("file,subject\n", "has no rows"),
        ("file,subject,subject\n1.csv,a,b\n", "has two columns 'subject'"),
        ("file,subject,\n1.csv,a,b\n", "unnamed column"),
        ("file,subject\n1.csv\n", "row 2 has 1 cells"),
        ('file,subject\n"1.csv,a\n', "no rows|cells"),
        ("file,subject,visit\n1.csv,a,../..\n", "visit: .* is no name"),
        ("file,subject,trial\n1.csv,a,b/c\n", "trial: .* is no name"),
        *((f"file,subject\n1.csv,{name}\n", "subject: .* is no name") for name in (
            "../../../../evil", "a\\b", "=HYPERLINK(1)", ".hidden", "\u202eb", "a" * 300, "a\0b")),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("text", "rows", "match"), FAULTS)
def test_faults_are_one_sentence(tmp_path: Path, text: str, rows: str, match: str) -> None:
    touch(tmp_path, "1.csv", "1.mat", "a b.txt", "a-b.txt")
    (tmp_path / "t.csv").write_bytes(rows.encode())
    with pytest.raises(impc.InputError, match=match) as caught:
        read_study(study(tmp_path, text))
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", [b"s1\xff.csv", b"s1\n2.csv", b"s1\x1b[2J.csv"])
def test_file_names_that_are_no_text(tmp_path: Path, name: bytes) -> None:
    (tmp_path / os.fsdecode(name)).write_text("x")
    with pytest.raises(impc.InputError, match="is no name") as caught:
        read_study(study(tmp_path, 'recordings = "s{subject}.csv"'))
    assert str(caught.value).isprintable()


PEOPLE = [
    ("subject;mass\n1;70,5\n", {"mass": 70.5}),
    ('subject,mass\n1,"70,5"\n', {"mass": 70.5}),
    ("subject\tmass\n1\t70,5\n", {"mass": 70.5}),
    ("subject;mass;note\n1;70,5;a, b\n", {"mass": 70.5, "note": "a, b"}),
    ("subject,mass,sex\n1,1e2,n/a\n", {"mass": 100.0}),
    ("subject,note\n1,1_000\n", {"note": "1_000"}),
    ("subject,mass\n1,1_000\n", "write a number in kg, or n/a"),
    ("subject;mass\n1;70.5\n2;70,5\n", "write it with a decimal point"),
    ('subject,mass\n1,"1,234"\n', "write it with a decimal point"),
    ("subject,mass\n1,nan\n", "write a number in kg"),
    ("subject,mass\n1,1e999\n", "write a number in kg"),
    ("subject,mass\n1,70\n1,80\n", "two rows of subject 1"),
    (
        "Proband;Alter;Masse (kg);Größe (cm)\n1;44;70,5;178\n",
        {"age": 44.0, "mass": 70.5, "height": 1.78},
    ),
    (
        "participant_id\tweight [g]\tGroesse (m)\nsub-1\t70500\t1.78\n",
        {"mass": 70.5, "height": 1.78},
    ),
    (
        "VP;mass_kg;Körpergröße / cm;Geschlecht (m/w)\n1;70;178;w\n",
        {"mass": 70.0, "height": 1.78, "sex": "female"},
    ),
    ("subject,gender\n1,F\n", {"sex": "female"}),
    ("subject,Geschlecht\n1,männlich\n", {"sex": "male"}),
    ("subject,sex\n1,divers\n", {"sex": "divers"}),
    ("subject,tau_d (ms),mass\n1,80,70\n", {"tau_d": 0.08, "mass": 70.0}),
    ("subject,height (kg)\n1,70\n", "kg is no unit of height, use m"),
    ("subject,Masse,Gewicht\n1,70,80\n", "two columns are mass, one of them 'Gewicht'"),
]


@pytest.mark.parametrize(("text", "expected"), PEOPLE)
def test_participants(tmp_path: Path, text: str, expected: str | dict[str, float | str]) -> None:
    path = with_people(tmp_path, text)
    if isinstance(expected, str):
        with pytest.raises(impc.InputError, match=expected):
            read_study(path)
    else:
        assert read_study(path).units[0].person == pytest.approx(expected)


def test_all_faults_of_participants_are_said_at_once(tmp_path: Path) -> None:
    path = with_people(tmp_path, "")
    rows = ["Proband;Gruppe;Maße;Masse (kg)", "1;a;;ca. 70", "1;a/b;;70", ";a;;nan", "2;a;;71,5"]
    (tmp_path / "p.csv").write_bytes("\n".join(rows).encode("cp1252"))
    with pytest.raises(impc.InputError) as caught:
        read_study(path)
    for part in (
        "row 2, mass: 'ca. 70'", "row 3, group: 'a/b' is no name", "row 3: two rows of subject 1",
        "row 4: has no subject", "row 4, mass: 'nan'", "nothing was fitted",
    ):  # fmt: skip
        assert part in str(caught.value)


def test_what_the_plant_refuses_is_said_before_any_fit(tmp_path: Path) -> None:
    text = "subject,mass,height,sex\n1,70,178,m\n2,70,1.8,f\n3,70,1.8,d\n"
    source = plant_source("plants:seated_balance_for", {})
    with pytest.raises(impc.InputError, match=r"row 2 \(1\): .*height.*row 4 \(3\): .*sex"):
        study_tasks(read_study(with_people(tmp_path, text, *"123")), source)


def test_columns_that_the_plant_does_not_take(tmp_path: Path) -> None:
    """The seat takes any parameter by name, but no age; a saved plant takes none."""

    def taken(found: Study, source: PlantSource) -> dict[str, object]:
        tasks, failed = study_tasks(found, source)
        assert failed == {}
        return tasks["sub-1"].arguments

    text = "Proband;Alter;Masse (kg);k_h;BMI (kg/m2)\n1;44;70,5;25;22\n"
    found, source = read_study(with_people(tmp_path, text)), "plants:seated_balance_for"
    assert unused_columns(found, plant_source(source, {})) == ("age", "BMI")
    assert taken(found, plant_source(source, {})) == {"mass": 70.5, "k_h": 25.0}
    found = read_study(with_people(tmp_path, "subject,age,drag\n1,44,0.5\n"))
    cart = plant_source("tests.studies.cohort.carts:cart_plant", {})
    assert unused_columns(found, cart) == ("age",)
    assert taken(found, cart) == {"drag": 0.5}
    assert unused_columns(found, PlantSource("p.json", lambda **_: None, {})) == ("age", "drag")


def test_an_unknown_reference_is_refused(tmp_path: Path) -> None:
    touch(tmp_path, "1_EO.csv", "1_EC.csv")
    text = 'recordings = "{subject}_{condition}.csv"\nreference = '
    assert read_study(study(tmp_path, f"{text}'EC'")).reference == "EC"
    with pytest.raises(impc.InputError, match=r"'eyes' is no group, .*; use one of EC, EO"):
        read_study(study(tmp_path, f"{text}'eyes'"))
