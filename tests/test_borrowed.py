"""Arrays whose users compiled code does not count."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impc.borrowed import borrowed
from impc.jit import njit

if TYPE_CHECKING:
    from impc.arrays import Buffer


class Inner(NamedTuple):
    whole: Buffer
    rows: int


class Outer(NamedTuple):
    inner: Inner
    lines: Buffer


@njit()
def doubled(given: Outer, times: int) -> float:
    """Doubles in place what is borrowed, so often; slices of it are handed on, too."""
    mine, total = borrowed(given), 0.0
    for _ in range(times):
        for i in range(mine.inner.rows):
            mine.lines[i] *= 2.0
            total += line(mine.lines[i : i + 1], mine.inner)
    return total


@njit()
def line(part: Buffer, inner: Inner) -> float:
    return float(part[0, 0] + inner.whole[0])


def test_what_is_borrowed_is_the_same_memory() -> None:
    given = Outer(Inner(np.array([1.0]), 3), np.ones((3, 2)))
    assert doubled(given, 2) == 3 * (2 + 1) + 3 * (4 + 1)
    assert np.all(given.lines == 4.0)


def test_nobody_loses_an_array_that_is_borrowed() -> None:
    """A count too few frees an array that is used, one too many never does."""
    given = Outer(Inner(np.array([1.0]), 3), np.ones((3, 2)))
    before = [sys.getrefcount(each) for each in (given.inner.whole, given.lines)]
    for _ in range(1000):
        doubled(given, 1)
        given.lines[:] = 1.0
    assert [sys.getrefcount(each) for each in (given.inner.whole, given.lines)] == before
