"""Where the rows of a recording begin and end, among titles, heads, settings and statistics.

A row is known by its kinds: a number, a word or nothing in each place. The recording begins at the
first row whose width and kinds go on below it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

#: Kinds of a cell.
EMPTY, NUMBER, WORD = 0, 1, 2
#: Rows among which the first row of numbers must be.
HEAD = 100
# Rows of one shape that are a recording, and where they begin with a word, as settings do.
_SEVERAL, _NAMED = 3, 20


@dataclass
class Block:
    """Rows of one shape: the index of the first, kinds of each place of all, and counts."""

    first: int  # Index of the first row, and how many rows, numbers and words it has
    kinds: list[int] = field(default_factory=list)  # Of each place, of all rows together
    rows: int = 0
    numbers: int = 0
    words: int = 0

    @property
    def width(self) -> int:
        """Places up to the last one that has numbers."""
        return max(
            (place + 1 for place, kind in enumerate(self.kinds) if kind == NUMBER), default=0
        )

    @property
    def share(self) -> float:
        """Share of numbers among all that is not empty."""
        return self.numbers / max(self.numbers + self.words, 1)

    @property
    def several(self) -> bool:
        """Whether it has several rows, which are mostly numbers."""
        return self.share > 0.5 and self.rows >= (_NAMED if self.kinds[0] == WORD else _SEVERAL)

    def fits(self, row: Sequence[int], after_blank: bool = False) -> bool:
        """Whether a row has the same shape: as many places, or fewer or more without numbers.

        One `after_blank`, an empty row, must have the first number of the rows above: the clock.
        """
        if after_blank and row[self.kinds.index(NUMBER) :][:1] != [NUMBER]:
            return False
        if len(row) < self.width or NUMBER in row[len(self.kinds) :]:
            return False
        return not any(
            {kind, own} == {NUMBER, WORD} for kind, own in zip(row, self.kinds, strict=False)
        )

    def add(self, row: Sequence[int]) -> None:
        """Take in a row that fits."""
        self.kinds += [EMPTY] * (len(row) - len(self.kinds))
        self.kinds[: len(row)] = [kind or own for kind, own in zip(row, self.kinds, strict=False)]
        self.rows += 1
        self.numbers += row.count(NUMBER)
        self.words += row.count(WORD)

    def ends_at(self, row: Sequence[int], following: Sequence[int], after_blank: bool) -> bool:
        """Whether a row that does not fit is where the block ends, and not a row that is damaged.

        It is `after_blank`, behind an empty row; or a head of words; or it begins with a word, as
        statistics do, and the `following` row does not fit either.
        """
        words = NUMBER not in row
        if after_blank or (words and row.count(WORD) > 1):
            return True
        label = WORD in row[: self.kinds.index(NUMBER) + 1]
        return (words or label) and not (following and self.fits(following))


def first_block(rows: Sequence[Sequence[int]], alone: bool) -> Block | None:
    """The first block of several `rows` that are mostly numbers, else that with most numbers.

    The rows are kinds, from the top of a file; `alone` says whether one may be a number alone. Rows
    as long as its own right above it that begin with a number too belong to it: they have a word in
    the place of a number.
    """
    blocks: list[Block] = []
    for index, row in enumerate(rows):
        if NUMBER not in row or (len(row) < 2 and not alone):
            continue
        if not (blocks and blocks[-1].first + blocks[-1].rows == index and blocks[-1].fits(row)):
            blocks.append(Block(index))
        blocks[-1].add(row)
    found = [block for block in blocks if block.share >= 0.5 and block.first < HEAD]
    if not found:
        return None
    most = max(found, key=lambda block: block.numbers)
    best = next((block for block in found if block.several), most)
    for above in reversed(blocks[: blocks.index(best)]):
        same = len(above.kinds) == len(best.kinds) and above.kinds[0] == best.kinds[0] == NUMBER
        if not same or above.share < 0.5 or above.first + above.rows != best.first:
            break
        best.first = above.first
    return best
