"""Reading a study: patterns, tables, BIDS-like names, participants, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import pytest

from impc.cohort.study import read_study
from impc.errors import InputError

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
    )
    found = read_study(study(tmp_path, 'bids = "."'))
    assert [(unit.name, len(unit.files)) for unit in found.units] == [
        ("sub-01_ses-1_task-EO", 2),
        ("sub-01_ses-2_task-EO", 1),
    ]


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
        ('recordings = "{subject}.csv"\nparticipants = "missing.csv"', "cannot be read"),
        ('recordings = "{subject}.csv"\nparticipants = "p.csv"', "is not in p.csv"),
        ('recordings = "{subject}.csv"\nparticipants = "q.csv"', "lacks a subject"),
        ('table = "q.csv"', "lacks a column"),
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


def test_names_that_fall_together_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "a b.csv", "a-b.csv")
    with pytest.raises(InputError, match="two units"):
        read_study(study(tmp_path, 'recordings = "{subject}.csv"'))
