"""The documentation site: pages in Markdown, the API from docstrings."""

from __future__ import annotations

import importlib.metadata

project = "impc"
author = "the impc authors"
release = importlib.metadata.version("impc")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "benchmarks/*.json"]
html_theme = "furo"
html_title = "impc"
myst_heading_anchors = 3
autosummary_generate = True
autodoc_default_options = {
    "members": True,
    "undoc-members": False,
    "show-inheritance": False,
    "ignore-module-all": True,
}
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
napoleon_use_rtype = False
napoleon_use_ivar = True
nitpicky = False
# Names of attributes in docstrings that two modules share are words here, not links.
suppress_warnings = ["ref.python"]


def _plain_text(app, what, name, obj, options, lines):  # type: ignore[no-untyped-def]
    """|u| is a magnitude, and an indented block an equation: neither is markup."""
    kept, inside = [], False
    for line in lines:
        text = line.replace("|", r"\|")
        indented = what == "module" and text.startswith("    ")
        if indented and not inside and (not kept or not kept[-1].strip()):
            kept += ["::", ""]
            inside = True
        if inside and text.strip() and not text.startswith(" "):
            if kept[-1].strip():
                kept.append("")
            inside = False
        kept.append(line if inside else text)
    lines[:] = kept


def setup(app):  # type: ignore[no-untyped-def]
    """Connect the hook."""
    app.connect("autodoc-process-docstring", _plain_text)
