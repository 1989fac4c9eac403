"""What an interrupted command had done: results by name, each computed once.

    name, digest of all that it is made of, compute -> the result, from the folder when it is there

One sealed file a result (`impc.files.sealed`). What belongs to another digest or was damaged is not
used and is done again. The results of a cohort are its product, not a help for the next run: there
the folder is read by `impc.studies.cohort.store`, which refuses what it does not know.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec
import numpy as np

from impc.arrays import frozen
from impc.files.sealed import Kept

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")


@dataclass(frozen=True)
class Codec(Generic[T]):
    """How a result is written down."""

    encode: Callable[[T], Any]  # Result -> JSON
    decode: Callable[[Any], T]  # Its inverse


def by_fields(kind: type[T]) -> Codec[T]:
    """A dataclass as its fields, arrays as lists."""
    return Codec(
        lambda value: msgspec.to_builtins(value, enc_hook=np.ndarray.tolist),
        lambda content: msgspec.convert(content, kind, dec_hook=lambda _, array: frozen(array)),
    )


@dataclass(frozen=True)
class Cache:
    """Results of the steps of a command."""

    files: Kept  # Its folder is made when the first result is kept
    digest: str  # Of all that the results are made of
    done: Callable[[str], None] = lambda _: None  # Told the name of each result when it is there
    # Name -> content of what is there, at first what the folder has for this digest
    stages: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stages.update(self.files.recall_all(self.digest))

    def get(self, name: str, compute: Callable[[], T], codec: Codec[T]) -> T:
        """The result `name`, from the folder or computed now and then written down."""
        if name not in self.stages:
            found = compute()
            self.keep(name, found, codec)
            return found
        self.done(name)
        return codec.decode(self.stages[name])

    def keep(self, name: str, value: T, codec: Codec[T]) -> None:
        """Write the result `name` down: `value`, as `codec` has it."""
        content = codec.encode(value)
        self.files.keep(name, self.digest, content)
        self.stages[name] = content
        self.done(name)

    def kept(self) -> str:
        """What to tell whoever interrupts the command."""
        if not self.stages:
            return "nothing was done yet"
        done = ", ".join(self.stages)
        return f"kept in {self.files.folder}: {done}; the same command goes on from there"

    def forget(self) -> None:
        """Remove the folder: the result has been written."""
        self.files.forget()
