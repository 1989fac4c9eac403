"""The fenced blocks of the README and of the pages, and the command lines in them."""

from __future__ import annotations

import re
import shlex
import textwrap
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

__all__ = ["PAGES", "ROOT", "Block", "blocks", "command_lines"]

ROOT = Path(__file__).parents[2]
#: README and pages by name; pages that a program writes are not among them.
PAGES = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if not path.relative_to(ROOT).parts[1:2] or path.relative_to(ROOT).parts[1][0] != "_"
    if "reproduction" not in path.parts
}
_FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\S*)[^\n]*\n(?P<text>.*?)^(?P=indent)```$", re.M | re.S
)
_FILE = re.compile(r"# (\S+\.\w+)\n")


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: str
    line: int
    language: str
    text: str
    output: str | None

    @property
    def file(self) -> str | None:
        """Name of the file that it is to be saved as: the comment in its first line."""
        found = _FILE.match(self.text)
        return None if found is None else found[1]


def blocks(page: str) -> tuple[Block, ...]:
    """All blocks of a page, in order; directives of Sphinx, ```{name}, are none."""
    content = PAGES[page].read_text(encoding="utf-8")
    fences = list(_FENCE.finditer(content))
    found = []
    for fence, after in zip_longest(fences, fences[1:]):
        if fence["language"].startswith("{"):
            continue
        follows = after is not None and not content[fence.end() : after.start()].strip()
        output = after["text"] if after and follows and after["language"] == "text" else None
        found.append(
            Block(
                page,
                content.count("\n", 0, fence.start("text")) + 1,
                fence["language"],
                textwrap.dedent(fence["text"]),
                None if output is None else textwrap.dedent(output),
            )
        )
    return tuple(found)


def command_lines(block: Block) -> tuple[str, ...]:
    """The lines of an `sh` block as they are typed: continued ones joined, without comments."""
    joined = block.text.replace("\\\n", " ")
    return tuple(line for line in map(_plain, joined.splitlines()) if line)


def _plain(line: str) -> str:
    words = shlex.shlex(line, posix=False, punctuation_chars=False)
    words.whitespace_split = True
    words.commenters = "#"
    return " ".join(words)
