"""Rules of a verdict as data: one row for each kind of finding, one builder for all studies.

A text is a template whose words in braces are functions of the facts, or their attributes: "It was
given as {limit}."
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from impc.levels import Level
from impc.reporting.verdict import Alert, Claim, Verdict

F = TypeVar("F")


def always(_: object) -> bool:
    """The condition of a row that always applies."""
    return True


@dataclass(frozen=True)
class Kind(Generic[F]):
    """A kind of finding: when it applies, what the page says, and what it forbids."""

    level: Level
    when: Callable[[F], object]
    headline: str
    sentence: str = ""
    title: str = ""  # Of the alert; without one there is none
    found: str = ""
    means: str = ""
    todo: Sequence[str] = ()  # Steps, in order; one that becomes empty is left out
    forbids: frozenset[str] = frozenset()
    badge: str = ""  # Replaces the usual words of the badge
    name: str = ""  # For programs that count pages by it


@dataclass(frozen=True)
class Line(Generic[F]):
    """A statement that may, or may not, be reported."""

    when: Callable[[F], object]
    text: str
    why: str = ""


#: Several statements of one sort, for example one for each measure.
Lines = Callable[[F], Sequence[Claim]]


@dataclass(frozen=True)
class Rules(Generic[F]):
    """The rules of a study: `kinds` worst first, the last applies always."""

    words: Mapping[str, Callable[[F], object]]  # In addition to the attributes of the facts
    kinds: Sequence[Kind[F]]
    may: Sequence[Line[F] | Lines[F]] = ()
    may_not: Sequence[Line[F] | Lines[F]] = ()

    def verdict(self, facts: F) -> Verdict:
        """Level and headline of the first kind that applies, and alerts of all of its level."""
        found = self.applying(facts)
        worst, words = found[0], _Words(self.words, facts)
        shown = [kind for kind in found if kind.level is worst.level and kind.title]
        return Verdict(
            worst.level,
            words.fill(worst.headline),
            words.fill(worst.sentence),
            [words.alert(kind) for kind in (shown[:1] if worst.level is Level.GREEN else shown)],
            words.claims(self.may),
            words.claims(self.may_not),
            words.fill(worst.badge),
            worst.name,
        )

    def applying(self, facts: F) -> list[Kind[F]]:
        """The kinds that apply, worst first."""
        return [kind for kind in self.kinds if kind.when(facts)]

    def reason(self, facts: F, result: str) -> str:
        """Title of the first kind that forbids a result; empty if none does."""
        found = (kind for kind in self.applying(facts) if result in kind.forbids)
        return next((_Words(self.words, facts).fill(kind.title) for kind in found), "")

    def forbidden(self, facts: F) -> frozenset[str]:
        """Results that the page must not show."""
        return frozenset().union(*(kind.forbids for kind in self.applying(facts)))


class _Words(dict[str, Any]):
    """Words by name, each made from the facts when a template asks for it."""

    def __init__(self, words: Mapping[str, Callable[[Any], object]], facts: object) -> None:
        self._words, self._facts = words, facts

    def __missing__(self, name: str) -> object:
        word = self._words.get(name)
        self[name] = getattr(self._facts, name) if word is None else word(self._facts)
        return self[name]

    def fill(self, text: str) -> str:
        return text.format_map(self)

    def alert(self, kind: Kind[Any]) -> Alert:
        level = Level.NOTE if kind.level is Level.GREEN else kind.level
        title, found, means = map(self.fill, (kind.title, kind.found, kind.means))
        return Alert(
            level, title, found, means, [step for step in map(self.fill, kind.todo) if step]
        )

    def claims(self, rows: Sequence[Line[Any] | Lines[Any]]) -> list[Claim]:
        found: list[Claim] = []
        for row in rows:
            if not isinstance(row, Line):
                found += row(self._facts)
            elif row.when(self._facts):
                found.append(Claim(self.fill(row.text), self.fill(row.why)))
        return found
