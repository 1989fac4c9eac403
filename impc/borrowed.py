"""Arrays that compiled code uses without counting who uses them.

numba counts the users of every array, one up and one down whenever an array is taken out of a tuple
or handed to a function. Each is a locked addition of twenty cycles, and of a filter that hands its
arrays to a dozen functions a sample these were half of the time (docs/noisy-people.md, "Cost").
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from numba.core import cgutils, types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["borrowed"]


def _borrowed(context: Any, value: Any) -> Any:
    """The same array, or tuple of arrays and tuples, whose users compiled code does not count.

    Whoever has the arrays must keep them until the last use of what is borrowed: what a compiled
    function is given by its caller in Python is kept while it runs.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], given[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """The value of a type `kind` with no array in it that has an owner."""
    if isinstance(kind, types.BaseTuple):
        kinds: list[Any] = list(kind)  # type: ignore[call-overload]
        parts = [
            _without_owner(context, builder, each, builder.extract_value(value, place))
            for place, each in enumerate(kinds)
        ]
        return context.make_tuple(builder, kind, parts)
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo, array.parent = _null(array.meminfo.type), _null(array.parent.type)
        return array._getvalue()  # numba's name for it
    return value


_null: Callable[[Any], Any] = cgutils.get_null_value

borrowed: Callable[[Any], Any] = cast("Any", intrinsic(_borrowed))
