"""The documentation site: pages in Markdown, tutorials that run, the API from docstrings."""

from __future__ import annotations

import importlib.metadata
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from modules import write_modules  # noqa: E402
from terminal import RESULTS, Pictures, figures_page  # noqa: E402

project = "impc"
author = "the impc authors"
project_copyright = "2026, the impc authors"
release = importlib.metadata.version("impc")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "_results", "tutorials", "benchmarks/*.json"]
html_theme = "furo"
html_title = "impc"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
myst_heading_anchors = 3
autosummary_generate = False
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
# Names of attributes in docstrings that two modules share are words here, not links.
suppress_warnings = ["ref.python"]

_TUTORIALS = r"tutorial_\d"
sphinx_gallery_conf = {
    "examples_dirs": str(HERE / "tutorials"),
    "gallery_dirs": str(HERE / "_tutorials"),
    "filename_pattern": _TUTORIALS,
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": (Pictures(),),
    "abort_on_example_error": True,
    "run_stale_examples": True,
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "show_signature": False,
    "remove_config_comments": True,
}


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


def _write_figures(app):  # type: ignore[no-untyped-def]
    """After the tutorials have run: the page of every figure."""
    (HERE / "_figures.md").write_text(figures_page(), encoding="utf-8")


def _skip_fields(app, what, name, obj, skip, options):  # type: ignore[no-untyped-def]
    """Fields are in the docstring of their class, with shapes and units: not bare once more."""
    documented = callable(obj) or isinstance(obj, (property, classmethod, staticmethod))
    return True if what == "class" and not documented else None


def _forget_results(app):  # type: ignore[no-untyped-def]
    """Tutorials begin with an empty folder, as their readers do."""
    if app.config.sphinx_gallery_conf["filename_pattern"] == _TUTORIALS:
        shutil.rmtree(RESULTS, ignore_errors=True)


def _write_modules(app):  # type: ignore[no-untyped-def]
    """Before anything is read: a page for each module."""
    write_modules(HERE / "_api", ("impc", "plants"))


def setup(app):  # type: ignore[no-untyped-def]
    """Connect the hooks."""
    app.connect("autodoc-process-docstring", _plain_text)
    app.connect("autodoc-skip-member", _skip_fields)
    # sphinx-gallery runs the tutorials at priority 500 of this event.
    app.connect("builder-inited", _forget_results, priority=100)
    app.connect("builder-inited", _write_modules, priority=100)
    app.connect("builder-inited", _write_figures, priority=900)
