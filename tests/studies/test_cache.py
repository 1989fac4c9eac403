"""A cache computes each result once, and uses nothing that is damaged or made of other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from impc.arrays import Array, Frozen, frozen
from impc.files.sealed import Kept
from impc.studies.cache import Cache, by_fields

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@dataclass(frozen=True)
class Found(Frozen):
    """What a step finds."""

    gain: Array
    parts: tuple[Array, ...]
    names: tuple[str, ...]
    value: float | None


CODEC = by_fields(Found)


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
    kept, told, made = Kept(tmp_path / "kept"), list[str](), list[int]()
    first = Cache(kept, "digest", told.append)
    assert first.kept() == "nothing was done yet"
    for seed in (1, 2):
        same(found(seed), first.get(f"step {seed}", counted(seed, made), CODEC))
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
    other = Cache(kept, "another" if damage == "other digest" else "digest", told.append)
    made.clear()
    for seed in (1, 2):
        same(found(seed), other.get(f"step {seed}", counted(seed, made), CODEC))
    assert made == again
    assert told == ["step 1", "step 2"] * 2
    assert "step 1" in other.kept()
    other.forget()
    assert not kept.folder.exists()


def test_a_step_that_fails_is_not_kept(tmp_path: Path) -> None:
    cache = Cache(Kept(tmp_path), "digest")
    with pytest.raises(ZeroDivisionError):
        cache.get("step", lambda: 1 / 0, CODEC)  # type: ignore[arg-type,return-value]
    assert cache.stages == {}
    assert list(tmp_path.iterdir()) == []
