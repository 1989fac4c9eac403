"""Mutated input ends in one line: a few hundred cases of a fixed seed; `make fuzz` runs more."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.fuzz.targets import TARGETS, Fuzzer

# Cases of each target, about two seconds.
_CASES = {".csv": 120, ".tsv": 60, ".txt": 60, ".mat": 400, ".tdms": 300, ".c3d": 150,
          ".xlsx": 120}  # fmt: skip


@pytest.mark.parametrize("target", TARGETS)
def test_mutated_input_ends_in_one_line(target: str, tmp_path: Path) -> None:
    fuzzer = Fuzzer(tmp_path, random.Random(20261))
    refused = 0
    cases = _CASES.get(target, 400)
    for _ in range(cases):
        _, read = TARGETS[target](fuzzer)
        refused += bool(fuzzer.reason(read))
    assert refused > cases / 4  # else nothing was tried


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_mutated_is_sound(target: str, tmp_path: Path) -> None:
    fuzzer = Fuzzer(tmp_path, random.Random(0))
    for content in fuzzer.sound.get(target, []):
        fuzzer.sound[target] = [content]
        path, read = fuzzer.file(target)
        path.write_bytes(content)
        assert fuzzer.reason(read) == ""
