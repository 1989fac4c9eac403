"""Bytes, text and numbers with something wrong in them."""

from __future__ import annotations

import random
import struct

__all__ = ["EDGES", "mutated_bytes", "mutated_text"]

#: Numbers at the edge of what a file can hold.
EDGES = (
    0.0, -1.0, 1e308, -1.7e308, 1e200, 1e12, 1e-12, 1e-200, 5e-324, float("inf"), float("nan"),
)  # fmt: skip
_WHOLE = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**32 - 1, 10**12, 2**63 - 1, 2**64 - 1)


def mutated_bytes(rng: random.Random, content: bytes) -> bytes:
    """A file in which one to four pieces are changed, most of them in its head."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        reach = len(found) if rng.random() < 0.5 else min(len(found), 1500)
        _change(rng, found, rng.randrange(max(1, reach)))
    return bytes(found)


def _change(rng: random.Random, found: bytearray, at: int) -> None:
    kind = rng.randrange(7)
    if kind == 0 and found:
        found[at % len(found)] ^= 1 << rng.randrange(8)
    elif kind == 1:
        found[at : at + 1] = bytes([rng.randrange(256)])
    elif kind == 2:
        size = rng.choice((1, 2, 4, 8))
        number = (rng.choice(_WHOLE) % 2 ** (8 * size)).to_bytes(size, "little")
        found[at : at + size] = number[:: rng.choice((1, -1))]
    elif kind == 3:
        found[at : at + 8] = struct.pack("<d", rng.choice(EDGES))
    elif kind == 4:
        del found[at : at + rng.choice((1, 2, 8, 100, len(found)))]
    elif kind == 5:
        found[at:at] = found[at : at + rng.choice((1, 8, 64, 1000))]
    else:
        length = rng.choice((4, 16, 200))
        found[at : at + length] = rng.randbytes(length)


def mutated_text(rng: random.Random, text: str, pieces: tuple[str, ...]) -> bytes:
    """A text in which values, lines and single characters are others."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(lines))
        kind = rng.randrange(5)
        if kind == 0:
            key, equals, _ = lines[at].partition("=")
            lines[at] = f"{key}{equals} {rng.choice(pieces)}" if equals else lines[at]
        elif kind == 1:
            lines.insert(at, rng.choice(pieces))
        elif kind == 2:
            lines.insert(rng.randrange(len(lines)), lines[at])
        elif kind == 3 and len(lines) > 1:
            del lines[at]
        else:
            return mutated_bytes(rng, "\n".join(lines).encode("utf-8", "surrogatepass"))
    return "\n".join(lines).encode("utf-8", "surrogatepass")
