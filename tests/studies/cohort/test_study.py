"""Reading a study: patterns, tables, BIDS names, participants, and error messages."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from impc.errors import InputError
from impc.files.plant_sources import PlantSource, plant_source
from impc.studies.cohort.study import read_study
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
        (folder / name).write_text("x")


def test_a_pattern_groups_trials_into_units(tmp_path: Path) -> None:
    touch(tmp_path, "d/s1/v1_EO_2.csv", "d/s1/v1_EO_10.csv", "d/s2/v1_EC_1.csv", "d/other.csv")
    found = read_study(
        study(tmp_path, 'recordings = "d/s{subject}/v{visit}_{condition}_{trial}.csv"')
    )
    assert [unit.name for unit in found.units] == ["sub-1_ses-1_task-EO", "sub-2_ses-1_task-EC"]
    # 2 before 10.
    assert [file.name for file in found.units[0].files] == ["v1_EO_2.csv", "v1_EO_10.csv"]


def test_a_name_may_come_twice_and_must_agree(tmp_path: Path) -> None:
    touch(tmp_path, "sub-1/sub-1_a.csv", "sub-1/sub-2_a.csv")
    found = read_study(study(tmp_path, 'recordings = "sub-{subject}/sub-{subject}_a.csv"'))
    assert [unit.name for unit in found.units] == ["sub-1"]


def test_bids_names(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "sub-01/ses-1/sub-01_ses-1_task-EO_run-1_motion.csv",
        "sub-01/ses-1/sub-01_ses-1_task-EO_run-2_motion.csv",
        "sub-01/ses-1/sub-01_ses-1_task-EO_run-2_motion.json",
        "sub-01/ses-2/sub-01_ses-2_task-EO_run-1_motion.csv",
        "sub-01/ses-2/.impc-k3/new/sub-01_ses-2_task-EO_run-2_motion.csv",
    )
    found = read_study(study(tmp_path, 'bids = "."'))
    assert [(unit.name, len(unit.files)) for unit in found.units] == [
        ("sub-01_ses-1_task-EO", 2),
        ("sub-01_ses-2_task-EO", 1),
    ]


def test_bids_finds_all_formats_and_no_trial_twice(tmp_path: Path) -> None:
    runs = ("1.csv", "2.CSV", "3.tsv", "4.txt", "5.xlsx", "6.XLSX", "7.ods", "8.mat", "9.sto")
    touch(tmp_path, *(f"sub-01/sub-01_task-x_run-{run}" for run in runs))
    (found,) = read_study(study(tmp_path, 'bids = "."')).units
    assert [file.name[-len(run) :] for file, run in zip(found.files, runs, strict=True)] == [*runs]
    touch(tmp_path, "sub-01/sub-01_task-x_run-1.xlsx")
    with pytest.raises(InputError, match=r"run-1\.xlsx', the same trial in two formats"):
        read_study(study(tmp_path, 'bids = "."'))


def test_a_table_and_participants(tmp_path: Path) -> None:
    touch(tmp_path, "x.csv", "y.csv")
    (tmp_path / "t.tsv").write_text("file\tsubject\ttrial\nx.csv\tA\t1\ny.csv\tA\t2\n")
    (tmp_path / "p.tsv").write_text("participant_id\tgroup\tmass\tsex\nsub-A\told\t70\tmale\n")
    found = read_study(study(tmp_path, 'table = "t.tsv"\nparticipants = "p.tsv"'))
    (unit,) = found.units
    assert unit.group == "old"
    assert unit.person == {"mass": 70.0, "sex": "male"}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "exactly one"),
        ('recordings = "{subject}.csv"\nbids = "."', "exactly one"),
        ('recordings = "{person}.csv"', "names person"),
        ('recordings = "{trial}.csv"', "names no subject"),
        ('recordings = "none-{subject}.csv"', "matches no file"),
        ('recordings = "{subject}.csv"\nparticipants = "missing.csv"', "does not exist"),
        ('recordings = "{subject}.csv"\nparticipants = "p.csv"', "is not in p.csv"),
        ('recordings = "{subject}.csv"\nparticipants = "q.csv"', "has no subject"),
        ('table = "q.csv"', "has a row without file"),
        ('recordings = "{subject}.csv"\nspeed = 1', "unknown field"),
    ],
)
def test_faults_are_one_sentence(tmp_path: Path, text: str, match: str) -> None:
    touch(tmp_path, "1.csv")
    (tmp_path / "p.csv").write_text("subject,group\nother,a\n")
    (tmp_path / "q.csv").write_text("name,group\nother,a\n")
    with pytest.raises(InputError, match=match) as caught:
        read_study(study(tmp_path, text))
    assert "\n" not in str(caught.value)


HOSTILE = [
    ("table = 't.csv'", "file,subject\n1.csv,../../../../evil\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,a/b\n", "is no name"),
    ("table = 't.csv'", "file,subject,visit\n1.csv,a,../..\n", "is no name"),
    ("table = 't.csv'", "file,subject,trial\n1.csv,a,b/c\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,a\\b\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,=HYPERLINK(1)\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,.hidden\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,\u202eb\n", "is no name"),
    ("table = 't.csv'", f"file,subject\n1.csv,{'a' * 300}\n", "is no name"),
    ("table = 't.csv'", "file,subject\n1.csv,a\0b\n", "is no name"),
    ("table = 't.csv'", "file,subject\n", "has no rows"),
    ("table = 't.csv'", "", "is empty"),
    ("table = 't.csv'", "file,subject,subject\n1.csv,a,b\n", "has two columns 'subject'"),
    ("table = 't.csv'", "file,subject,\n1.csv,a,b\n", "unnamed column"),
    ("table = 't.csv'", "file,subject\n1.csv\n", "row 2 has 1 cells"),
    ("table = 't.csv'", "file,subject\n1.csv,\n", "without file or subject"),
    ("table = 't.csv'", 'file,subject\n"1.csv,a\n', "no rows|cells"),
    ("table = '.'", "", "is a folder"),
    ("table = ''", "", "study.table: is empty"),
    ("bids = ' '", "", "study.bids: is empty"),
    ("recordings = ''", "", "study.recordings: is empty"),
    ('recordings = "{subject}\\u0000.csv"', "", "study.recordings: is empty"),
    ("recordings = '{subject}.csv'\nparticipants = ''", "", "study.participants: is empty"),
    ("recordings = '/nowhere/{subject}.csv'", "", "matches no file"),
    ("recordings = '**/{subject}.csv'", "", "invalid pattern"),
    ("recordings = '{subject}{trial}{visit}.csv'", "", "a separator between two"),
    ("recordings = '{subject!r}.csv'", "", "names no subject"),
    ("recordings = '[{subject}.csv'", "", "matches no file"),
]


@pytest.mark.parametrize(("text", "rows", "match"), HOSTILE)
def test_hostile_studies_are_one_sentence(tmp_path: Path, text: str, rows: str, match: str) -> None:
    touch(tmp_path, "1.csv")
    (tmp_path / "t.csv").write_bytes(rows.encode())
    with pytest.raises(InputError, match=match) as caught:
        read_study(study(tmp_path, text))
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
    ("subject;mass\n1;70,500\n", "write it with a decimal point"),
    ("subject,mass\n1,nan\n", "write a number in kg"),
    ("subject,mass\n1,-inf\n", "write a number in kg"),
    ("subject,mass\n1,1e999\n", "write a number in kg"),
    ("subject,mass\n1,70\n1,80\n", "two rows of subject 1"),
    ("subject,mass,mass\n1,70,80\n", "has two columns 'mass'"),
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
    ("subject,sex\n1,M\n", {"sex": "male"}),
    ("subject,gender\n1,F\n", {"sex": "female"}),
    ("subject,Geschlecht\n1,männlich\n", {"sex": "male"}),
    ("subject,sex\n1,divers\n", {"sex": "divers"}),
    ("subject,tau_d (ms),mass\n1,80,70\n", {"tau_d": 0.08, "mass": 70.0}),
    ("subject,height (kg)\n1,70\n", "kg is no unit of height, use m"),
    ("subject,Masse,Gewicht\n1,70,80\n", "two columns are mass, one of them 'Gewicht'"),
    ("subject,mass\n1,70,5\n", "row 2 has 3 cells"),
    ("subject,group\n1,a/b\n", "is no name"),
    ("subject,mass\n", "has no rows"),
]


@pytest.mark.parametrize(("text", "expected"), PEOPLE)
def test_participants(tmp_path: Path, text: str, expected: str | dict[str, float | str]) -> None:
    touch(tmp_path, "s1.csv")
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    path = study(tmp_path, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            read_study(path)
    else:
        assert read_study(path).units[0].person == pytest.approx(expected)


def test_all_faults_of_participants_are_said_at_once(tmp_path: Path) -> None:
    touch(tmp_path, "s1.csv")
    rows = ["Proband;Gruppe;Masse (kg)", "1;a;ca. 70", "1;a/b;70", ";a;nan", "2;a;71,5"]
    (tmp_path / "p.csv").write_bytes("\n".join(rows).encode("cp1252"))
    path = study(tmp_path, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')
    with pytest.raises(InputError) as caught:
        read_study(path)
    for part in (
        "row 2, mass: 'ca. 70'", "row 3, group: 'a/b' is no name", "row 3: two rows of subject 1",
        "row 4: has no subject", "row 4, mass: 'nan'", "nothing was fitted",
    ):  # fmt: skip
        assert part in str(caught.value)


def test_what_the_plant_refuses_is_said_before_any_fit(tmp_path: Path) -> None:
    touch(tmp_path, "s1.csv", "s2.csv", "s3.csv")
    (tmp_path / "p.csv").write_text("subject,mass,height,sex\n1,70,178,m\n2,70,1.8,f\n3,70,1.8,d\n")
    path = study(tmp_path, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')
    source = plant_source("plants:seated_balance_for", {})
    with pytest.raises(InputError, match=r"row 2 \(1\): .*height.*row 4 \(3\): .*sex"):
        study_tasks(read_study(path), source)


def test_a_further_column_does_not_stop_the_seat(tmp_path: Path) -> None:
    """The seat takes any parameter by name, but no age."""
    touch(tmp_path, "s1.csv")
    (tmp_path / "p.csv").write_text("Proband;Alter;Masse (kg);k_h;BMI (kg/m2)\n1;44;70,5;25;22\n")
    path = study(tmp_path, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')
    found, source = read_study(path), plant_source("plants:seated_balance_for", {})
    assert unused_columns(found, source) == ("age", "BMI")
    tasks, _ = study_tasks(found, source)
    assert tasks["sub-1"].arguments == {"mass": 70.5, "k_h": 25.0}


def test_formats_may_be_mixed(tmp_path: Path) -> None:
    touch(tmp_path, "P1_1.csv", "P1_2.xlsx", "P2_1.XLSX", "P2_1.doc")
    units = read_study(study(tmp_path, 'recordings = "{subject}_{trial}.*"')).units
    assert [[file.name for file in unit.files] for unit in units] == [
        ["P1_1.csv", "P1_2.xlsx"], ["P2_1.XLSX"],
    ]  # fmt: skip


def test_an_unknown_reference_is_refused(tmp_path: Path) -> None:
    touch(tmp_path, "1_EO.csv", "1_EC.csv")
    text = 'recordings = "{subject}_{condition}.csv"\nreference = '
    assert read_study(study(tmp_path, f"{text}'EC'")).reference == "EC"
    with pytest.raises(InputError, match=r"'eyes' is no group, .*; use one of EC, EO"):
        read_study(study(tmp_path, f"{text}'eyes'"))


@pytest.mark.parametrize("name", [b"s1\xff.csv", b"s1\n2.csv", b"s1\x1b[2J.csv"])
def test_file_names_that_are_no_text(tmp_path: Path, name: bytes) -> None:
    (tmp_path / os.fsdecode(name)).write_text("x")
    with pytest.raises(InputError, match="is no name") as caught:
        read_study(study(tmp_path, 'recordings = "s{subject}.csv"'))
    assert str(caught.value).isprintable()


def test_accents_composed_and_not_are_one_name(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("file,subject,trial\n1.csv,Ren\u00e9,1\n2.csv,Rene\u0301,2\n")
    (unit,) = read_study(study(tmp_path, "table = 't.csv'")).units
    assert (unit.subject, len(unit.files)) == ("Ren\u00e9", 2)
    assert unit.name.isascii()


def test_an_absolute_pattern_and_brackets_in_it(tmp_path: Path) -> None:
    touch(tmp_path, "d[1]/s1.csv", "d1/s2.csv")
    found = read_study(
        study(tmp_path, f'recordings = "{tmp_path.as_posix()}/d[1]/s{{subject}}.csv"')
    )
    assert [unit.subject for unit in found.units] == ["1"]


def test_columns_that_the_plant_does_not_take(tmp_path: Path) -> None:
    """A column `age` that is not an argument of the plant is reported and not used."""
    touch(tmp_path, "s1.csv")
    (tmp_path / "p.csv").write_text("subject,age,drag\n1,44,0.5\n")
    path = study(tmp_path, 'recordings = "s{subject}.csv"\nparticipants = "p.csv"')
    found, source = read_study(path), plant_source("tests.studies.cohort.carts:cart_plant", {})
    assert unused_columns(found, source) == ("age",)
    tasks, failed = study_tasks(found, source)
    assert tasks["sub-1"].arguments == {"drag": 0.5}
    assert failed == {}
    saved = PlantSource("p.json", lambda **_: None, {})
    assert unused_columns(found, saved) == ("age", "drag")


def test_names_that_fall_together_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "a b.csv", "a-b.csv")
    with pytest.raises(InputError, match="two units"):
        read_study(study(tmp_path, 'recordings = "{subject}.csv"'))
