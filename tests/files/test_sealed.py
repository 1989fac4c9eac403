"""Results that are kept: what they are told from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from impc.errors import InputError, OutputError
from impc.files.sealed import Kept


def test_what_is_kept_reads_the_same(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "kept")
    content = {
        "x": np.random.default_rng(0).standard_normal(50).tolist(),
        "n": None,
        "t": "µ\ud800",
    }
    assert kept.find("a/b", "d") is None
    kept.keep("a/b", "d", content)
    assert kept.find("a/b", "d") == content
    assert kept.recall_all("d") == {"a/b": content}
    assert kept.recall_all("other") == {}
    with pytest.raises(InputError, match="other recordings"):
        kept.find("a/b", "other")
    kept.forget()
    kept.forget()
    assert not kept.folder.exists()


def test_names_that_fall_together_are_told_apart(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.keep("trial 1", "d", 1)
    with pytest.raises(InputError, match="other recordings"):
        kept.find("trial-1", "d")
    assert kept.recall_all("d") == {"trial 1": 1}


def test_a_seal_of_the_right_form_and_wrong_value(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.keep("a", "d", {"gain": -24.95})
    found = json.loads(kept.path("a").read_text())
    assert list(found) == ["sha256", "content", "digest", "name"]
    for key, value in (
        ("digest", "e"),
        ("name", "b"),
        ("content", {"gain": -34.04}),
        ("sha256", 3),
    ):
        kept.path("a").write_text(json.dumps(found | {key: value}))
        with pytest.raises(InputError, match="is damaged"):
            kept.find("a", "d")
        assert kept.recall_all("d") == {}


def test_a_link_in_the_place_of_the_draft_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.write_text("mine")
    (tmp_path / ".a.json.part").symlink_to(target)
    Kept(tmp_path).keep("a", "d", 1)
    assert target.read_text() == "mine"


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("")
    with pytest.raises(OutputError, match="cannot be written") as caught:
        Kept(tmp_path / "kept").keep("a", "d", 1)
    assert "\n" not in str(caught.value)


def test_only_what_was_kept_is_forgotten(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "fit-in-progress")
    for name in ("one", "two/three"):
        kept.keep(name, "digest", [1.0])
    (tmp_path / "fit-in-progress" / "notes.txt").write_text("mine")
    (tmp_path / "fit-in-progress" / "table.json").write_text("[1]")
    kept.forget()
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(left) == ["notes.txt", "table.json"]
    (tmp_path / "fit-in-progress" / "notes.txt").unlink()
    (tmp_path / "fit-in-progress" / "table.json").unlink()
    kept.keep("one", "digest", [1.0])
    kept.forget()
    assert list(tmp_path.iterdir()) == []
    kept.forget()
