"""The tags of a MATLAB .mat file of version 5 to 7, looked at before scipy reads it.

A file is a header of 128 bytes and a sequence of elements: a tag of 8 bytes (type, length), then as
many bytes. An array is an element of elements. scipy's reader looks types up in a table without
looking at its end, so that a flipped bit ends the process or takes what stands behind the table for
a type; and it takes the memory that a length asks for. Nothing is read here but tags: whether the
elements are those that scipy expects is not known, and some that are not end its process. They do
it at the address zero, as the types that are let through are all in the table or empty in it.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

from impc.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["look_at_tags", "too_large"]

# Types of elements: numbers and text, arrays (of elements), and a variable packed by zlib.
_PLAIN = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
_MATRIX, _PACKED = 14, 15
_FLAGS = (6, 8)  # type and length of the first element of an array: scipy takes them for granted
_NESTED = 100  # arrays within one another: scipy's reader calls itself for each


def look_at_tags(path: Path, largest: int) -> None:
    """Require types that exist, lengths that are there, and `largest` bytes unpacked at the most.

    The header of the file at `path` is not looked at.
    """
    content = memoryview(path.read_bytes())
    order = "<" if bytes(content[126:128]) == b"IM" else ">"  # as scipy has it
    left = largest
    for kind, size, inside in _elements(content[128:], order, padded=False):
        left -= size
        if left < 0:
            raise too_large(path, largest - left)
        if kind == _PACKED:
            unpacked = _unpacked(path, inside, order, left)
            left -= len(unpacked)
            for each, _, matrix in _elements(unpacked, order, padded=False):
                _look_into(each, matrix, order, 0)
        else:
            _look_into(kind, inside, order, 0)


def _unpacked(path: Path, packed: memoryview, order: str, most: int) -> memoryview:
    """What zlib packed: as many bytes as the tag in front of it says, and no more than `most`."""
    try:
        tag = zlib.decompressobj().decompress(packed, 8).ljust(8, b"\0")
        size = 8 + struct.unpack(f"{order}II", tag)[1]
        if size > most:
            raise too_large(path, size)
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(packed, size)
        surplus = unpacker.decompress(unpacker.unconsumed_tail, 1)  # reads the checksum
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if surplus or not unpacker.eof:
        raise ValueError("a packed variable is not as long as it says")
    return memoryview(content)


def too_large(path: Path, size: int) -> DataError:
    """The reason to raise for the file at `path`, whose variables take `size` bytes."""
    return DataError(
        str(path),
        f"would take {size / 1e9:.1f} GB once it is unpacked",
        "save only the signals that are needed",
    )


def _look_into(kind: int, content: memoryview, order: str, depth: int) -> None:
    """The tags within an array, which is all that may stand here."""
    if kind != _MATRIX:
        raise ValueError(f"an element of type {kind} is out of place")
    if depth > _NESTED:
        raise ValueError(f"more than {_NESTED} arrays within one another")
    if content and bytes(content[:8]) != struct.pack(f"{order}II", *_FLAGS):
        raise ValueError("an array without flags")
    for inner, _, inside in _elements(content, order):
        if inner not in _PLAIN:
            _look_into(inner, inside, order, depth + 1)


def _elements(
    content: memoryview, order: str, padded: bool = True
) -> Iterator[tuple[int, int, memoryview]]:
    """Type, length and bytes of each element that stands in `content`."""
    tag = struct.Struct(f"{order}II")
    at = 0
    while at < len(content):
        if at + 8 > len(content):
            raise ValueError("the file ends in the middle of an array")
        kind, size = tag.unpack_from(content, at)
        begin = at + 8
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
            if size > 4 or kind not in _PLAIN:
                raise ValueError(f"an element of type {kind} has {size} bytes in its tag")
        else:
            at = begin + size + (-size % 8 if padded else 0)
        if begin + size > len(content):
            raise ValueError(f"an element of type {kind} has fewer bytes than it says")
        yield kind, size, content[begin : begin + size]
