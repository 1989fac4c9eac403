"""Compiled code: arrays whose users numba does not count.

numba counts the users of each array whenever it is taken out of a tuple or passed to a function,
with a locked addition. In loops that pass dozens of arrays at each sample this is a third of the
time (`python -m experiments.benchmarks`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numba.core import cgutils, types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from collections.abc import Callable


def _borrowed(_context: Any, value: Any) -> Any:
    """Return an array, or a tuple of arrays and tuples, without counters.

    The caller must keep the arrays: those that Python passes to a compiled function live until it
    returns.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _without_owner(context, builder, signature.args[0], given[0])

    return value(value), generate


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Value of the type `kind` in which no array has an owner."""
    if isinstance(kind, types.BaseTuple):
        kinds: list[Any] = list(kind)  # type: ignore[call-overload]
        parts = [
            _without_owner(context, builder, each, builder.extract_value(value, place))
            for place, each in enumerate(kinds)
        ]
        return context.make_tuple(builder, kind, parts)
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = _null(array.meminfo.type)
        array.parent = _null(array.parent.type)
        return array._getvalue()
    return value


make: Any = intrinsic
_null: Any = cgutils.get_null_value
borrowed: Callable[[Any], Any] = make(_borrowed)
