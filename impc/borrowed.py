"""Arrays that compiled code uses without counting who uses them.

numba counts the users of every array, one up and one down whenever an array is taken out of a tuple
or handed to a function. Each is a locked addition of twenty cycles, and of a filter that hands its
arrays to a dozen functions a sample these were half of the time (docs/noisy-people.md, "Cost").
"""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

__all__ = ["borrowed"]


@intrinsic  # type: ignore[untyped-decorator]
def borrowed(_: Any, value: Any) -> Any:
    """The same array, or tuple of arrays, whose users are not counted.

    Whoever has the array must keep it until the last use of what is borrowed: what a compiled
    function is given by its caller in Python is kept while it runs.

    Parameters
    ----------
    value : Buffer or tuple
        Tuples in tuples, too; what is no array stays as it is.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], given[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.BaseTuple):
        parts = [
            _without_owner(context, builder, each, builder.extract_value(value, place))
            for place, each in enumerate(kind)
        ]
        return context.make_tuple(builder, kind, parts)
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()  # noqa: SLF001  # numba's name for it
    return value
