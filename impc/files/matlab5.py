"""The variables of MATLAB .mat files of version 5 to 7, from the published layout of the format.

A file is a header of 128 bytes and a sequence of elements: a tag of 8 bytes (type, length), then as
many bytes. An array is an element of elements: its class, its sizes, its name, its numbers. Every
length is compared with what is there before anything is taken, so that a damaged file ends in
`ValueError`; scipy's reader ends the process instead for some types that do not exist.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["Cells", "Other", "Text", "TooLargeError", "read_variables"]

# Types of elements: numbers by their kind in numpy, text, and what holds others.
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_TEXTS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_MATRIX, _PACKED = 14, 15
# Classes of arrays.
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMERIC = range(6, 16)
_OTHERS = {_SPARSE: "sparse; save full(x)", _FUNCTION: "not numeric (a function)"}
_COMPLEX = 0x800
# A recording has some dozen of them; a file can hold one in 48 bytes.
_MOST_ARRAYS = 10_000
_DEPTH = 16


class TooLargeError(Exception):
    """More bytes than were allowed: the only argument is their number."""


@dataclass(frozen=True)
class Text:
    """An array of characters.

    Attributes
    ----------
    rows : tuple of str
        Without blanks behind them.
    """

    rows: tuple[str, ...]


@dataclass(frozen=True)
class Cells:
    """A cell array.

    Attributes
    ----------
    values : tuple of object
        Column by column, each as in `read_variables`.
    """

    values: tuple[Any, ...]


@dataclass(frozen=True)
class Other:
    """What is neither real numbers, text, cells nor a struct of one element.

    Attributes
    ----------
    kind : str
        What it is, as the end of a sentence that begins with "is".
    """

    kind: str


@dataclass
class _Limits:
    """What may still be taken while a file is read."""

    largest: int
    taken: int = 0
    arrays: int = 0

    def take(self, size: int) -> None:
        self.taken += size
        if self.taken > self.largest:
            raise TooLargeError(self.taken)

    def count(self, depth: int) -> None:
        self.arrays += 1
        if self.arrays > _MOST_ARRAYS:
            raise ValueError(f"more than {_MOST_ARRAYS} arrays")
        if depth > _DEPTH:
            raise ValueError(f"more than {_DEPTH} arrays within one another")


@dataclass
class _Elements:
    """A reader of the elements in a piece of memory; `order` is "<" or ">"."""

    content: memoryview
    order: str
    at: int = 0

    def more(self) -> bool:
        return self.at < len(self.content)

    def next(self, padded: bool = True) -> tuple[int, memoryview]:
        """Type and bytes of the next element."""
        if self.at + 8 > len(self.content):
            raise ValueError("the file ends in the middle of an array")
        kind, size = struct.unpack_from(f"{self.order}II", self.content, self.at)
        begin = self.at + 8
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, begin = kind & 0xFFFF, kind >> 16, self.at + 4
            if size > 4:
                raise ValueError(f"an element of type {kind} has {size} bytes in its tag")
            self.at += 8
        else:
            self.at = begin + size + (-size % 8 if padded else 0)
        if begin + size > len(self.content):
            raise ValueError(f"an element of type {kind} has fewer bytes than it says")
        return kind, self.content[begin : begin + size]

    def numbers(self) -> np.ndarray[Any, Any]:
        """The next element, which must hold numbers, in the byte order of this machine."""
        kind, content = self.next()
        if kind not in _NUMBERS:
            raise ValueError(f"an element of type {kind} where numbers are expected")
        dtype = np.dtype(self.order + _NUMBERS[kind])
        if len(content) % dtype.itemsize:
            raise ValueError(f"an element of type {kind} has {len(content)} bytes")
        found = np.frombuffer(content, dtype)
        return found.astype(dtype.newbyteorder("="), copy=False)

    def name(self) -> str:
        kind, content = self.next()
        if kind not in (1, 2, 16):
            raise ValueError(f"an element of type {kind} where a name is expected")
        return bytes(content).decode("utf-8", "replace")


def read_variables(path: Path, largest: int) -> dict[str, Any]:
    """The variables of a file by name.

    Parameters
    ----------
    path : Path
        Of a file whose header has been checked.
    largest : int
        The most bytes that its arrays may take, unpacked and as float64.

    Returns
    -------
    dict of str to object
        Real numeric arrays (numpy, MATLAB's sizes), `Text`, `Cells`, structs of one element
        (dict), or `Other`.

    Raises
    ------
    ValueError
        When the file is damaged or holds two variables of one name.
    TooLargeError
        When its arrays take more than `largest` bytes.
    """
    content = memoryview(path.read_bytes())
    order = ">" if bytes(content[126:128]) == b"MI" else "<"
    limits = _Limits(largest)
    found: dict[str, Any] = {}
    for matrix in _matrices(content[128:], order, limits):
        name, value = _array(matrix, order, limits, 0)
        if not name:  # what objects refer to
            continue
        if name in found:
            raise ValueError(f"two variables {name!r}")
        found[name] = value
    return found


def _matrices(content: memoryview, order: str, limits: _Limits) -> Iterator[memoryview]:
    """The arrays of a file, unpacked one after the other."""
    elements = _Elements(content, order)
    while elements.more():
        kind, inside = elements.next(padded=False)
        if kind == _PACKED:
            kind, inside = _Elements(_unpacked(inside, order, limits), order).next(padded=False)
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} where a variable is expected")
        yield inside


def _unpacked(packed: memoryview, order: str, limits: _Limits) -> memoryview:
    """What zlib packed: as many bytes as the tag in front of it says, and no more."""
    try:
        tag = zlib.decompressobj().decompress(packed[:256], 8)
        if len(tag) < 8:
            raise ValueError("a packed variable without a tag")
        size = 8 + struct.unpack(f"{order}II", tag)[1]
        limits.take(size)
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(packed, size)
        surplus = unpacker.decompress(unpacker.unconsumed_tail, 1)  # reads the checksum
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if len(content) != size or surplus or not unpacker.eof:
        raise ValueError("a packed variable is not as long as it says")
    return memoryview(content)


def _array(content: memoryview, order: str, limits: _Limits, depth: int) -> tuple[str, Any]:
    """Name and value of the array in these bytes."""
    limits.count(depth)
    if not content:
        return "", np.zeros((0, 0))
    elements = _Elements(content, order)
    flags = elements.numbers()
    if flags.dtype != np.uint32 or len(flags) != 2:
        raise ValueError("an array without flags")
    if int(flags[0]) & 0xFF == _OPAQUE:  # no sizes; name, system of its class, and the class
        name, _, what = elements.name(), elements.name(), elements.name()
        return name, Other(f"a MATLAB {what}")
    sizes = elements.numbers()  # int32; some writers call it uint32
    if sizes.dtype.itemsize != 4 or sizes.dtype.kind == "f" or len(sizes) < 2 or min(sizes) < 0:
        raise ValueError("an array without sizes")
    shape = tuple(int(size) for size in sizes)
    return elements.name(), _value(int(flags[0]), shape, elements, limits, depth)


def _value(
    flags: int, shape: tuple[int, ...], elements: _Elements, limits: _Limits, depth: int
) -> Any:
    """What stands behind class, sizes and name."""
    kind = flags & 0xFF
    if kind in _NUMERIC:
        value: Any = _numbers(elements, shape, bool(flags & _COMPLEX), limits)
    elif kind == _CHAR:
        value = _text(elements, shape, limits)
    elif kind == _CELL:
        value = _cells(elements, shape, limits, depth)
    elif kind == _STRUCT:
        value = _struct(elements, shape, limits, depth)
    elif kind == _OBJECT:
        value = Other(f"a MATLAB object of class {elements.name()}")
    elif kind in _OTHERS:
        value = Other(_OTHERS[kind])
    else:
        raise ValueError(f"an array of class {kind}")
    return value


def _numbers(elements: _Elements, shape: tuple[int, ...], is_complex: bool, limits: _Limits) -> Any:
    if is_complex:
        return Other("complex")
    limits.take(8 * prod(shape))
    numbers = elements.numbers()
    if len(numbers) != prod(shape):
        raise ValueError(f"an array of {prod(shape)} numbers has {len(numbers)}")
    return numbers.reshape(shape, order="F")


def _text(elements: _Elements, shape: tuple[int, ...], limits: _Limits) -> Text:
    """Rows of characters; those of an array of more than two dimensions are one row."""
    kind, content = elements.next()
    limits.take(8 * len(content))
    order = {"<": "-le", ">": "-be"}[elements.order]
    encodings = {1: "latin-1", 2: "latin-1", 4: f"utf-16{order}", 16: "utf-8"}
    encodings |= {number: name + order for number, name in _TEXTS.items() if number != 16}
    if kind not in encodings:
        raise ValueError(f"text in an element of type {kind}")
    text = bytes(content).decode(encodings[kind], "replace")
    rows = shape[0] if len(shape) == 2 and prod(shape) == len(text) else min(1, len(text))
    return Text(tuple(text[row::rows].rstrip() for row in range(rows)))


def _cells(elements: _Elements, shape: tuple[int, ...], limits: _Limits, depth: int) -> Cells:
    return Cells(
        tuple(_inner(elements, limits, depth) for _ in range(_counted(prod(shape), limits)))
    )


def _struct(elements: _Elements, shape: tuple[int, ...], limits: _Limits, depth: int) -> Any:
    width = elements.numbers()
    names = elements.name()
    if len(width) != 1 or width[0] <= 0 or len(names) % int(width[0]):
        raise ValueError("a struct without names")
    step = int(width[0])
    fields = [names[at : at + step].split("\0")[0] for at in range(0, len(names), step)]
    if prod(shape) != 1:
        return Other(f"an array of {prod(shape)} structs; save each as a file of its own")
    _counted(len(fields), limits)
    if len(set(fields)) < len(fields):
        raise ValueError("a struct with two fields of one name")
    return {field: _inner(elements, limits, depth) for field in fields}


def _counted(arrays: int, limits: _Limits) -> int:
    if arrays > _MOST_ARRAYS - limits.arrays:
        raise ValueError(f"more than {_MOST_ARRAYS} arrays")
    return arrays


def _inner(elements: _Elements, limits: _Limits, depth: int) -> Any:
    kind, content = elements.next()
    if kind != _MATRIX:
        raise ValueError(f"an element of type {kind} where an array is expected")
    return _array(content, elements.order, limits, depth + 1)[1]
