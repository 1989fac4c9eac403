"""Places of numba's cache that do not depend on the path of a checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numba.core import config
from numba.core.caching import UserProvidedCacheLocator


class ByModule(UserProvidedCacheLocator):
    """Folder in numba's CACHE_DIR that is named by a function's module, not by its path."""

    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)  # type: ignore[no-untyped-call]
        self._cache_path = str(Path(config.CACHE_DIR, function.__module__))  # type: ignore[attr-defined]
