"""A plant by name: the one place where the library meets plants."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from impc.errors import InputError

if TYPE_CHECKING:
    from impc.plant import Plant

__all__ = ["load_plant"]


def load_plant(path: str) -> Plant:
    """Make the plant of an import path ``module:function``.

    Raises
    ------
    InputError
        When there is no such module or function.
    """
    from impc.plant import as_plant  # noqa: PLC0415

    module, _, function = path.partition(":")
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"plant {path}", f"cannot be imported ({error})", "install the whole checkout"
        ) from None
    return as_plant(make())
