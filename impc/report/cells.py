"""Cells of tables that other programs open."""

from __future__ import annotations

__all__ = ["guarded_cell"]

# What spreadsheets take for the beginning of a formula.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")


def guarded_cell(text: str) -> str:
    """A cell that no spreadsheet takes for a formula: with an apostrophe before, unless a number.

    Parameters
    ----------
    text : str
        As it should read.
    """
    if not text.startswith(_FORMULA):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text
