"""Numbers as options: click lets nan and infinity through every range."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from click import Context, Parameter

__all__ = ["LARGEST_SEED", "Number"]

#: Numbers drawn for trial k of a seed follow from 100 seed + k, which has to be one of 64 bits.
LARGEST_SEED = 10**15


class Number(click.FloatRange):
    """A number between two others; `nan` and `inf` are none."""

    name = "number"

    def convert(self, value: Any, param: Parameter | None, ctx: Context | None) -> float:
        """The number that `value` says; click gives `param` and `ctx` for its message."""
        found = float(super().convert(value, param, ctx))
        if not math.isfinite(found):
            self.fail(f"{value} is no number to compute with.", param, ctx)
        return found
