"""Keep libraries from reading settings files of the working folder.

matplotlib reads `matplotlibrc`, numba `.numba_config.yaml` and IPOPT `ipopt.opt` in the folder in
which a command is run, which may hold other people's files (docs/ref/security.md).
"""

from __future__ import annotations

import importlib.abc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, nullcontext
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

#: Options with which IPOPT prints nothing and reads no file. With ipopt.opt it could overwrite any
#: file, or load a library as its linear solver.
IPOPT_ALONE: dict[str, Any] = {"print_level": 0, "sb": "yes", "option_file_name": ""}


def ignore_settings_files(*libraries: str) -> None:
    """Import these `libraries` without their settings files."""
    for library in libraries:
        if not any(isinstance(item, _Finder) and item.name == library for item in sys.meta_path):
            sys.meta_path.insert(0, _Finder(library))


class _Finder(importlib.abc.MetaPathFinder):
    """Find one library like the other finders, and run its `__init__` in another folder."""

    def __init__(self, name: str) -> None:
        self.name = name

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Specification of the library; None for other modules."""
        if fullname != self.name:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((item for item in found if item is not None), None)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module

            def away(module: ModuleType) -> None:
                with _away():
                    execute(module)
                if fullname == "numba":
                    # numba reads it again before each compilation: an empty name matches nothing.
                    sys.modules["numba.core.config"].__dict__["_config_fname"] = ""

            loader.exec_module = away
        return spec


@contextmanager
def _away() -> Iterator[None]:
    """Work in this package's folder, and hide yaml, with which numba would read its file."""
    try:
        os.getcwd()
    except OSError:  # the folder no longer exists
        elsewhere: Any = nullcontext()
    else:
        elsewhere = chdir(Path(__file__).parent)
    yaml = sys.modules.get("yaml")
    sys.modules["yaml"] = None  # type: ignore[assignment]
    try:
        with elsewhere:
            yield
    finally:
        del sys.modules["yaml"]
        if yaml is not None:
            sys.modules["yaml"] = yaml
