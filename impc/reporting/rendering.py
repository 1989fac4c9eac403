"""What the pages share: the template, numbers in a cell, values as JSON has them."""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from impc.reporting.glossary import Glossary

if TYPE_CHECKING:
    from impc.reporting.document import Report

_HERE = Path(__file__).parent
#: The library that draws curves; `vendor` holds its licence.
_LIBRARY = "vendor/uPlot.iife.min.js", "vendor/uPlot.min.css"
_NOTICE = "/* uPlot 1.6.31, (c) 2022 Leon Sorokin, MIT licence */"
# Between a number and its unit, and within a unit, no line ends.
_UNIT = r"(\d) (%|N m|N\b|s\b|m\b|kg\b|ms\b|deg\b|Hz\b|°)"
_KEPT = re.compile(rf"{_UNIT}|(N) (m)\b|(p) (=|<)|(=|<) (\d)")
_ICONS = {
    "green": '<path d="M3 8.5l3.2 3.2L13 4.8"/>',
    "amber": '<path d="M8 2L15 14H1zM8 6.6v3.4M8 11.9v.2"/>',
    "red": '<path d="M4 4l8 8M12 4l-8 8"/>',
    "note": '<circle cx="8" cy="8" r="6.3"/><path d="M8 7.4v3.6M8 4.9v.2"/>',
}


def render_page(report: Report, charts: bool) -> str:
    """The page of a report; all texts that enter it are escaped."""
    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    glossary = Glossary()
    environment.filters["prose"] = lambda text: _unbroken(glossary.marked(text))
    environment.filters["unbroken"] = _unbroken
    environment.filters["name"] = _name
    environment.globals["icon"] = lambda level: Markup(
        '<svg viewBox="0 0 16 16" aria-hidden="true">{}</svg>'
    ).format(Markup(_ICONS[level.value]))
    scripts = [_script("page.js"), *([_library()] if charts else [])]
    sheet = Markup(_read(_LIBRARY[1])) if charts else ""
    page = environment.get_template("page.html")
    return _encodable(page.render(report=report, scripts=scripts[::-1], sheet=sheet))


def _unbroken(text: str) -> Markup:
    """The text with spaces that are not broken where a number and its unit stand."""
    parts = re.split(r"(<[^>]*>)", str(escape(text)))
    kept = [part if part.startswith("<") else _KEPT.sub(_joined, part) for part in parts]
    return Markup("".join(kept))  # of escaped text: nothing but spaces is another


def _name(text: str) -> Markup:
    """What a row of a table is called; names as programs write them stand as code."""
    coded = re.fullmatch(r"[A-Za-z]\w*_[\w.]+", text)
    return Markup("<code>{}</code>").format(text) if coded else _unbroken(text)


def _joined(found: re.Match[str]) -> str:
    first, second = (part for part in found.groups() if part is not None)
    return "\u00a0".join((first, *second.split(" ")))


def _read(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


@functools.cache
def _script(name: str) -> dict[str, str]:
    """A script of ours, and the hash by which the policy of a page lets it run."""
    return _sealed(_read(name))


@functools.cache
def _library() -> dict[str, str]:
    """The library without its first line, which holds an address: a page has none."""
    _, _, text = _read(_LIBRARY[0]).partition("\n")
    return _sealed(f"{_NOTICE}\n{text}")


def _sealed(text: str) -> dict[str, str]:
    seal = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return {"text": Markup(text), "sha256": seal}  # our own files: nothing of a user's is in them


def number(value: float, digits: int = 3) -> str:
    """A `value` for a table cell, to so many significant `digits`; words where there is none."""
    if np.isnan(value):
        return "-"
    if np.isinf(value):
        return "not determined"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-4 <= abs(value) < 1e7:
        text = f"{float(text):.0f}"
    return text.replace("-", "\u2212", 1) if text.startswith("-") else text


def probability(value: float) -> str:
    """A p-value as it is printed."""
    return "p < 0.001" if value < 1e-3 else f"p = {number(value, 2)}"


def fixed(value: float, digits: int = 3) -> str:
    """As `number`, and zeros at the end stay: 13.0 beside 15.6."""
    text = number(value, digits)
    if not np.isfinite(value) or "e" in text:
        return text
    shown = f"{value:#.{digits}g}".rstrip(".").replace("-", "\u2212", 1)
    return text if "e" in shown else shown


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
