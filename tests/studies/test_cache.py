"""Cache: each result is computed once; damaged or foreign files are ignored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impc.arrays import Array, Frozen, frozen
from impc.studies.cache import Cache, Steps, from_json


@dataclass(frozen=True)
class Found(Frozen):
    """Result of a step."""

    gain: Array
    parts: tuple[Array, ...]
    names: tuple[str, ...]
    value: float | None


def decode(kept: Any) -> Found:
    return from_json(kept, Found)


def found(seed: int) -> Found:
    rng = np.random.default_rng(seed)
    parts = tuple(frozen(rng.standard_normal(2)) for _ in range(2))
    return Found(frozen(rng.standard_normal((2, 3))), parts, ("a", "b"), None)


def same(one: Found, other: Found) -> None:
    np.testing.assert_array_equal(one.gain, other.gain)
    for mine, theirs in zip(one.parts, other.parts, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert (one.names, one.value) == (other.names, other.value)
    assert not other.gain.flags.writeable


def counted(seed: int, made: list[int]) -> Callable[[], Found]:
    def compute() -> Found:
        made.append(seed)
        return found(seed)

    return compute


@pytest.mark.parametrize(
    ("damage", "again"),
    [("nothing", []), ("other digest", [1, 2]), ("cut", [1]), ("flipped", [1]), ("copied", [1])],
)
def test_what_is_kept_is_not_done_again(tmp_path: Path, damage: str, again: list[int]) -> None:
    kept, stated, made = Cache(tmp_path / "kept"), list[tuple[str, bool]](), list[int]()

    def state(name: str, *, found: bool) -> None:
        stated.append((name, found))

    first = Steps(kept, "digest", state)
    assert first.kept() == "no step was finished"
    for seed in (1, 2):
        same(found(seed), first.get(f"step {seed}", counted(seed, made), decode))
    assert made == [1, 2]
    path = kept.path("step 1")
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[:-9])
    elif damage == "flipped":
        place = content.index(b".") + 1
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
    elif damage == "copied":
        path.write_bytes(kept.path("step 2").read_bytes())
    other = Steps(kept, "another" if damage == "other digest" else "digest", state)
    made.clear()
    for seed in (1, 2):
        same(found(seed), other.get(f"step {seed}", counted(seed, made), decode))
    assert made == again
    assert stated[:2] == [("step 1", False), ("step 2", False)]
    assert stated[2:] == [(f"step {seed}", seed not in again) for seed in (1, 2)]
    assert "step 1" in other.kept()
    kept.forget()
    assert not kept.folder.exists()


def test_a_step_that_fails_is_not_kept(tmp_path: Path) -> None:
    steps = Steps(Cache(tmp_path), "digest")
    with pytest.raises(ZeroDivisionError):
        steps.get("step", lambda: 1 / 0, decode)
    assert steps.names == {}
    assert list(tmp_path.iterdir()) == []


def test_names_that_fall_together_are_told_apart(tmp_path: Path) -> None:
    kept = Cache(tmp_path)
    kept.keep("trial 1", "d", 1)
    assert kept.find("trial-1", "d") is None
    assert kept.find("trial 1", "d") == 1
    assert (kept.digest("trial 1"), kept.digest("trial 2")) == ("d", None)


def test_a_link_in_the_place_of_the_draft_is_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.write_text("mine")
    (tmp_path / ".a.json.part").symlink_to(target)
    Cache(tmp_path).keep("a", "d", 1)
    assert target.read_text() == "mine"


def test_only_what_was_kept_is_forgotten(tmp_path: Path) -> None:
    kept = Cache(tmp_path / "fit-in-progress")
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
