"""Array types, conversion of numeric input, and read-only copies."""

from __future__ import annotations

import numbers
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impc.errors import DataError, InputError

#: Array of float64; docstrings give its shape.
Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
#: Array of int64.
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
#: Array of booleans.
BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
#: control.StateSpace, or an object with its attributes.
System = Any
#: casadi.SX, MX or DM, a list of them, or numbers.
Expression = Any
#: Array of any element type, as compiled code takes it.
Buffer = np.ndarray[Any, np.dtype[Any]]


class Frozen:
    """Base of frozen dataclasses: arrays stay read-only in copies and pickles; short repr.

    numpy makes the arrays of copies and pickles writable. The repr is one line, with small arrays
    in full and others by shape.
    """

    def __init_subclass__(cls) -> None:
        if "__repr__" not in vars(cls):  # that of a dataclass would print every sample
            cls.__repr__ = Frozen.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        named = fields(self)  # type: ignore[arg-type]  # a dataclass
        parts = (f"{item.name}={_brief(getattr(self, item.name))}" for item in named)
        return f"{type(self).__name__}({', '.join(parts)})"

    def __getstate__(self) -> dict[str, Any]:
        """State without cached values, which are recomputed on demand."""
        named = {item.name for item in fields(self)}  # type: ignore[arg-type]  # a dataclass
        return {name: value for name, value in vars(self).items() if name in named}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            for item in value if isinstance(value, tuple) else (value,):
                if isinstance(item, np.ndarray):
                    item.flags.writeable = False
            object.__setattr__(self, name, value)


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if value.size <= 6:
            return np.array2string(value, precision=4, separator=", ").replace("\n", "")
        return f"array{value.shape}"
    if isinstance(value, Frozen):
        return f"<{type(value).__name__}>"
    if isinstance(value, tuple) and value and isinstance(value[0], Frozen):
        return f"<{len(value)} {type(value[0]).__name__}>"
    text = repr(value)
    return text if len(text) <= 60 else f"<{type(value).__name__}>"


def frozen(values: ArrayLike) -> Array:
    """Return a read-only float64 copy; `values` any shape; returns same shape."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def percentiles(drawn: ArrayLike, level: float) -> tuple[Array, Array]:
    """Ends of the central interval with the share `level` of draws; `drawn` any shape."""
    values = np.asarray(drawn, dtype=np.float64)
    low, high = np.quantile(values, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    return np.asarray(low), np.asarray(high)


def as_numbers(name: str, values: ArrayLike) -> Array:
    """Convert real numbers of any kind to float64; masked entries become NaN.

    Accepts lists, tuples, arrays, and series and frames of pandas; rejects text, complex numbers
    and dates, some of which numpy would convert. `values` any shape; returns same shape.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    if isinstance(values, np.ma.MaskedArray):
        if values.dtype.kind not in "biuf":
            raise _not_numbers(name, f"an array of {values.dtype}")
        masked: Any = values.astype(np.float64)
        return np.asarray(masked.filled(np.nan), dtype=np.float64)
    try:
        raw = np.asarray(values)
        if raw.dtype.kind == "O" and all(_is_real(entry) for entry in raw.flat):
            # Integers beyond int64, fractions, NA of pandas; None would become NaN.
            real = [np.nan if repr(entry) == "<NA>" else float(entry) for entry in raw.flat]
            raw = np.array(real, dtype=np.float64).reshape(raw.shape)
    except (TypeError, ValueError, OverflowError, AttributeError):
        raise _not_numbers(name, type(values).__name__) from None
    if raw.dtype.kind not in "biuf":
        raise _not_numbers(name, f"an array of {raw.dtype}" if raw.shape else str(raw.dtype))
    with np.errstate(over="ignore"):  # longdouble overflows to inf, which `finite_array` rejects
        return np.asarray(raw, dtype=np.float64)


def _is_real(entry: object) -> bool:
    return isinstance(entry, numbers.Real) or repr(entry) == "<NA>"


def _not_numbers(name: str, got: str) -> DataError:
    return DataError(
        name, f"expected real numbers, got {got}", "give an array or lists of equal length"
    )


def finite_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Convert to float64; require the shape and finite entries. `values` any shape."""
    array = with_shape(name, as_numbers(name, values), shape)
    require_finite(name, array)
    return array


def with_shape(name: str, array: Array, shape: tuple[int | None, ...]) -> Array:
    """Return the array if it has the shape; `array` any shape; returns that shape."""
    wanted = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"

    def fits(given: tuple[int, ...]) -> bool:
        pairs = zip(shape, given, strict=False)
        return len(given) == len(shape) and all(size in (None, found) for size, found in pairs)

    if not fits(array.shape):
        turned = array.ndim > 1 and fits(array.shape[::-1])
        remedy = f"transpose it: {name}.T" if turned else "reshape it"
        raise DataError(name, f"expected shape {wanted}, got {array.shape}", remedy)
    return array


def require_finite(name: str, array: Array) -> None:
    """Require finite entries; `array` any shape."""
    if np.all(np.isfinite(array)):
        return
    bad = np.argwhere(~np.isfinite(array))
    first = tuple(int(index) for index in bad[0])
    raise DataError(
        name,
        f"{len(bad)} of {array.size} entries are NaN or infinite, the first at {first}",
        "remove or repair those samples before fitting",
    )


def symmetric_matrix(name: str, values: ArrayLike, size: int | None = None) -> Array:
    """Convert to a symmetric float64 matrix (size, size); relative asymmetry must be <= 1e-9."""
    given = as_numbers(name, values)
    if given.ndim != 0 and (given.ndim != 2 or given.size == 0):
        diagonal = f"np.diag({given.tolist()})" if given.size < 6 else "np.diag(...)"
        remedy = f"for a diagonal {name} pass {diagonal}" if given.ndim == 1 else "give (n, n)"
        raise DataError(name, f"expected a square matrix, got shape {given.shape}", remedy)
    # R of a single input is usually written as a number.
    matrix = finite_array(name, given.reshape(1, 1) if given.ndim == 0 else given, (size, size))
    if matrix.shape[0] != matrix.shape[1]:
        raise DataError(name, f"expected a square matrix, got {matrix.shape}", "make it square")
    scale = float(np.max(np.abs(matrix), initial=0.0))
    if float(np.max(np.abs(matrix - matrix.T), initial=0.0)) > 1e-9 * scale:
        raise InputError(name, "is not symmetric", "give (M + M')/2")
    return np.asarray(matrix / 2 + matrix.T / 2)  # the sum could overflow
