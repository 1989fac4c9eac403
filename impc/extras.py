"""Optional libraries: import them, or say how to install them.

A plain installation supports `impc example`, and `impc fit` and `impc compare` with CSV and MATLAB
files. The other libraries are extras of pyproject.toml (docs/install.md).
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from impc.errors import ImpcError

#: Import name of each optional library -> extra of pyproject.toml that installs it.
EXTRAS = {
    "c3d": "c3d",
    "distributed": "cohort",
    "nptdms": "tdms",
    "python_calamine": "excel",
    "pytope": "polytope",
    "starlette": "app",
    "tomlkit": "app",
    "uvicorn": "app",
}


def optional(library: str, subject: str) -> Any:
    """Import an optional library."""
    try:
        return importlib.import_module(library)
    except ImportError:
        remedy = f"install it: pip install 'impc[{EXTRAS[library]}]'"
        raise ImpcError(subject, f"needs the package {library}", remedy) from None


def installed(library: str) -> bool:
    """Whether an optional `library` is installed, without importing it."""
    return importlib.util.find_spec(library) is not None
