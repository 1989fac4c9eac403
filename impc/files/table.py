"""A file as it stands: named columns of equal length, before anything is made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from impc.arrays import Array

__all__ = ["Table"]


@dataclass(frozen=True)
class Table:
    """The numeric columns of one file.

    Attributes
    ----------
    source : str
        Where they come from, for messages.
    columns : mapping of str to Array
        By name, in the order of the file, each (samples,). NaN where the file has no value.
    units : mapping of str to str
        Units of the columns for which the file tells them, as it writes them.
    rate : float or None
        Samples per second, where the file tells it itself (TDMS, C3D).
    """

    source: str
    columns: Mapping[str, Array]
    units: Mapping[str, str]
    rate: float | None
