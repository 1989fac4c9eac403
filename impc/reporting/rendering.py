"""What the pages share: the template environment, pictures inside a page, numbers in a cell."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

__all__ = ["TextTable", "embedded", "number", "plain", "render_template"]


@dataclass(frozen=True)
class TextTable:
    """A table of texts.

    Attributes
    ----------
    caption : str
        Above the table.
    heads : tuple of str
        One a column.
    rows : tuple of tuple of str
        Their first cell is a head of its own.
    """

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def render_template(name: str, **values: Any) -> str:
    """Render a template of this package; all `values` that enter it are escaped.

    Templates of this folder go by their name, others by their path: "studies/fit/fit_page.html".
    """
    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader([here, here.parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return _encodable(environment.get_template(name).render(**values))


def embedded(png: bytes) -> str:
    """The picture `png` as the address of an <img> that needs no other file."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def number(value: float, digits: int = 3) -> str:
    """A `value` for a table cell, to so many significant `digits`; words where there is none."""
    if np.isnan(value):
        return "-"
    if np.isinf(value):
        return "not determined"
    return f"{value:.{digits}g}"


def plain(value: Any) -> Any:
    """A `value` with its arrays and numpy numbers as lists and numbers, at every depth.

    JSON knows neither NaN nor infinity: both become null. Bytes of a file's name that are not UTF-8
    are escaped.
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, str):
        return _encodable(value)
    return value


def _encodable(text: str) -> str:
    """The text in UTF-8: Python keeps bytes of a name that are none as halves of characters."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
