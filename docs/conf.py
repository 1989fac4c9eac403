"""The documentation site: Markdown pages, a reference made from the code, examples that run."""

from __future__ import annotations

import importlib.metadata
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from reference import write_reference  # noqa: E402
from terminal import RESULTS, Pictures  # noqa: E402

project = "impc"
author = "the impc authors"
project_copyright = "2026, the impc authors"
release = importlib.metadata.version("impc")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "sphinx_reredirects",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "_results", "_reference", "examples"]
html_theme = "furo"
html_title = "impc"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
myst_heading_anchors = 3
autosummary_generate = False
autodoc_default_options = {"members": True, "undoc-members": False}
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
napoleon_use_rtype = False
napoleon_use_ivar = True
# `n` and `m` in docstrings are sizes; two classes have attributes of these names.
suppress_warnings = ["ref.python"]

# Old names of pages, which reports of earlier versions show.
redirects = {
    "start": "tutorials/first_subject.html",
    "api": "ref/api.html",
    "architecture": "dev/architecture.html",
    "benchmarks/results": "../howto/speed.html",
    "casadi": "howto/matlab_casadi.html",
    "cohorts": "howto/cohort.html",
    "comparing": "howto/compare.html",
    "conditioned-fit": "why/theory.html",
    "contributing": "dev/contributing.html",
    "cursor-tracking": "howto/tracking.html",
    "equivalent-weights": "why/equivalent_weights.html",
    "fitting": "howto/fit.html",
    "matlab": "howto/matlab_casadi.html",
    "noisy-people": "why/output_feedback.html",
    "nonlinear": "howto/nonlinear.html",
    "nonlinear-seat": "howto/nonlinear.html",
    "planning": "howto/plan.html",
    "recipes": "howto/recipes.html",
    "recordings": "howto/recordings.html",
    "release": "dev/architecture.html",
    "reliability": "howto/reliability_selection.html",
    "results": "ref/results.html",
    "security": "ref/security.html",
    "selection": "howto/reliability_selection.html",
    "speed": "howto/speed.html",
    "structures": "howto/weights.html",
    "theory": "why/theory.html",
    "troubleshooting": "ref/errors.html",
    "units": "howto/recordings.html",
    "what-may-be-concluded": "why/conclusions.html",
}

sphinx_gallery_conf = {
    "examples_dirs": str(HERE / "examples"),
    "gallery_dirs": str(HERE / "_examples"),
    "filename_pattern": ".py",
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
    """In docstrings |u| is a magnitude, not a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def _skip_fields(app, what, name, obj, skip, options):  # type: ignore[no-untyped-def]
    """The docstring of a class describes its fields; they have no entries of their own."""
    documented = callable(obj) or isinstance(obj, (property, classmethod, staticmethod))
    return True if what == "class" and not documented else None


def _prepare(app):  # type: ignore[no-untyped-def]
    """Write the reference; examples start with an empty folder, as readers do."""
    write_reference(HERE / "_reference")
    if app.config.sphinx_gallery_conf["filename_pattern"] == ".py":
        shutil.rmtree(RESULTS, ignore_errors=True)


def setup(app):  # type: ignore[no-untyped-def]
    """Connect the hooks; sphinx-gallery runs the examples at priority 500 of `builder-inited`."""
    app.connect("autodoc-process-docstring", _plain_text)
    app.connect("autodoc-skip-member", _skip_fields)
    app.connect("builder-inited", _prepare, priority=100)
