"""Optional libraries: each is imported here, or one line says how to get it.

A plain installation has what `impc example`, and `impc fit` and `impc compare` of CSV and MATLAB
files need. The rest are extras of pyproject.toml, listed in docs/release.md.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from impc.errors import ImpcError

#: Optional library, as it is imported -> the extra of pyproject.toml that brings it.
EXTRAS = {
    "c3d": "c3d",
    "distributed": "cohort",
    "nptdms": "tdms",
    "python_calamine": "excel",
    "pytope": "polytope",
}


def optional(library: str, subject: str) -> Any:
    """The module of an optional library."""
    try:
        return importlib.import_module(library)
    except ImportError:
        remedy = f"install it: pip install 'impc[{EXTRAS[library]}]'"
        raise ImpcError(subject, f"needs the package {library}", remedy) from None


def installed(library: str) -> bool:
    """Whether an optional `library` is there; it is not imported."""
    return importlib.util.find_spec(library) is not None
