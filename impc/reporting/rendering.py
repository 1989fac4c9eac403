"""What the pages share: the template environment, numbers in a cell, values as JSON has them."""

from __future__ import annotations

import base64
import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup


def render_page(**values: Any) -> str:
    """Render page.html; all `values` that enter it are escaped."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return _encodable(environment.get_template("page.html").render(script=_script(), **values))


@functools.cache
def _script() -> dict[str, str]:
    """The one script of every page, and the hash by which its policy lets this one run."""
    text = Path(__file__).with_name("page.js").read_text(encoding="utf-8")
    seal = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return {"text": Markup(text), "sha256": seal}  # our own file: nothing of a user's is in it


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
