"""Rendering of pages, formatting of numbers, and conversion of values to JSON."""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from impc.reporting.glossary import Glossary

_HERE = Path(__file__).parent
#: Plotting library; its licence is in `vendor`.
_LIBRARY = "vendor/uPlot.iife.min.js", "vendor/uPlot.min.css"
_NOTICE = "/* uPlot 1.6.31, (c) 2022 Leon Sorokin, MIT licence */"
# No line break between a number and its unit, or within a unit.
_UNIT = r"(\d) (%|N m|N\b|s\b|m\b|kg\b|ms\b|deg\b|Hz\b|°)"
_KEPT = re.compile(rf"{_UNIT}|(N) (m)\b|(p) (=|<)|(=|<) (\d)")
_ICONS = {
    "green": '<path d="M3 8.5l3.2 3.2L13 4.8"/>',
    "amber": '<path d="M8 2L15 14H1zM8 6.6v3.4M8 11.9v.2"/>',
    "red": '<path d="M4 4l8 8M12 4l-8 8"/>',
    "note": '<circle cx="8" cy="8" r="6.3"/><path d="M8 7.4v3.6M8 4.9v.2"/>',
}


def render_page(report: object, charts: bool) -> str:
    """Render the page of a `document.Report` by the template; all texts are escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # noqa: PLC0415

    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
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
    """Escaped text with non-breaking spaces between numbers and units."""
    parts = re.split(r"(<[^>]*>)", str(escape(text)))
    kept = [part if part.startswith("<") else _KEPT.sub(_joined, part) for part in parts]
    return Markup("".join(kept))  # already escaped: only spaces were replaced


def _name(text: str) -> Markup:
    """First cell of a table row; names with underscores are set as code."""
    coded = re.fullmatch(r"[A-Za-z]\w*_[\w.]+", text)
    return Markup("<code>{}</code>").format(text) if coded else _unbroken(text)


def _joined(found: re.Match[str]) -> str:
    first, second = (part for part in found.groups() if part is not None)
    return "\u00a0".join((first, *second.split(" ")))


def _read(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


@functools.cache
def _script(name: str) -> dict[str, str]:
    """One of our scripts with its hash for the content security policy of the page."""
    return _sealed(_read(name))


@functools.cache
def _library() -> dict[str, str]:
    """The library without its first line, which contains a URL: pages must contain none."""
    _, _, text = _read(_LIBRARY[0]).partition("\n")
    return _sealed(f"{_NOTICE}\n{text}")


def report_script_hashes() -> tuple[str, ...]:
    """SHA-256 (base64) of the scripts that the content security policy of pages allows."""
    return _script("page.js")["sha256"], _library()["sha256"]


def _sealed(text: str) -> dict[str, str]:
    seal = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return {"text": Markup(text), "sha256": seal}  # safe: no user input in our own files


def sentence_case(text: str) -> str:
    """Text with a capital first letter; a first word that may be a name or unit keeps its case."""
    plain_word = re.match(r"[a-z]{2,}(?![\w\[])", text)
    return f"{text[0].upper()}{text[1:]}" if plain_word else text


def number(value: float, digits: int = 3) -> str:
    """Format a `value` for a table cell to `digits` significant digits."""
    if np.isnan(value):
        return "-"
    if np.isinf(value):
        return "not determined"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-4 <= abs(value) < 1e7:
        text = f"{float(text):.0f}"
    return text.replace("-", "\u2212", 1) if text.startswith("-") else text


def probability(value: float) -> str:
    """Format a p-value."""
    return "p < 0.001" if value < 1e-3 else f"p = {number(value, 2)}"


def p_value(value: float) -> str:
    """Format a p-value as statistics programs do: three digits, no zero before the point."""
    return "< .001" if value < 1e-3 else f"{value:.3f}".replace("0.", ".", 1)


def fixed(value: float, digits: int = 3) -> str:
    """Format as `number` does, but keep trailing zeros (13.0)."""
    text = number(value, digits)
    if not np.isfinite(value) or "e" in text:
        return text
    shown = f"{value:#.{digits}g}".rstrip(".").replace("-", "\u2212", 1)
    return text if "e" in shown else shown


def plain(value: Any) -> Any:
    """Values for JSON at every depth; not finite: None, bytes that are not UTF-8: escaped."""
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
    """Escape surrogates, by which Python represents bytes of file names that are not UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
