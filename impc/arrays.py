"""Arrays at the door: generous with what comes in, strict with what is kept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impc.errors import DataError, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Array",
    "BoolArray",
    "Buffer",
    "IntArray",
    "finite_array",
    "frozen",
    "symmetric_matrix",
]

#: An array of float64, of the shape that each docstring gives.
Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
#: An array of int64.
IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
#: An array of truth values.
BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
#: An array as compiled code takes it, of any element type.
Buffer = np.ndarray[Any, np.dtype[Any]]


def frozen(values: ArrayLike) -> Array:
    """Return a read-only float64 copy, so that a frozen dataclass is frozen to the last entry.

    Parameters
    ----------
    values : array_like
        Numbers, of any shape.

    Returns
    -------
    Array
        Of the same shape.
    """
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def finite_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Convert to float64 and check the shape and that every entry is finite.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    values : array_like
        What the caller gave, of any shape.
    shape : tuple
        Expected shape; ``None`` where any length will do.

    Returns
    -------
    Array
        Of that shape.

    Raises
    ------
    DataError
        When the values are not numbers, have another shape, or are not all finite.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(name, f"expected numbers, got {values!r:.60}", "give an array") from None
    wanted = "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"
    if array.ndim != len(shape) or any(
        size is not None and size != given for size, given in zip(shape, array.shape, strict=True)
    ):
        raise DataError(name, f"expected shape {wanted}, got {array.shape}", "reshape it")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        first = tuple(int(index) for index in bad[0])
        raise DataError(
            name,
            f"{len(bad)} of {array.size} entries are NaN or infinite, the first at {first}",
            "remove or repair those samples before fitting",
        )
    return array


def symmetric_matrix(name: str, values: ArrayLike, size: int | None = None) -> Array:
    """Convert to a square symmetric float64 matrix; asymmetry above 1e-9 relative is an error.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    values : array_like
        (size, size), or a number for (1, 1).
    size : int, optional
        Expected number of rows; any by default.

    Returns
    -------
    Array
        (size, size).

    Raises
    ------
    DataError
        When the values are not a finite matrix of that size.
    InputError
        When the matrix is not symmetric.
    """
    scalar = np.ndim(values) == 0  # R of a single input is usually written as a number
    matrix: NDArray[np.float64] = finite_array(
        name, np.reshape(values, (1, 1)) if scalar else values, (size, size)
    )
    if matrix.shape[0] != matrix.shape[1]:
        raise DataError(name, f"expected a square matrix, got {matrix.shape}", "give it square")
    scale = float(np.max(np.abs(matrix), initial=0.0))
    if float(np.max(np.abs(matrix - matrix.T), initial=0.0)) > 1e-9 * scale:
        raise InputError(name, "is not symmetric", "give (M + M')/2")
    return (matrix + matrix.T) / 2
