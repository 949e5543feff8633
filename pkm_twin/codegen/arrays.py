# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read a caller's numbers as arrays of doubles; reject anything else.

numpy converts more than can be meant: it drops the mask of a masked array and the imaginary part
of a complex one, reads text and dates as numbers, and makes NaN of None.
"""

from __future__ import annotations

import math
from decimal import Decimal
from numbers import Real
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

ROUNDING_NOISE: Final = 8.0 * float(np.finfo(np.float64).eps)
"""Relative noise of computed numbers: rounding of the last digits in a few operations."""

_F8: Final = np.dtype(np.float64)


def doubles(values: ArrayLike, what: str = "values") -> Array:
    """Convert real numbers to an array of float64; return such an array itself, without a copy.

    :param what: name of the values, for errors.
    :raises ValueError: anything but real numbers, or masked ones.
    """
    if type(values) is np.ndarray and values.dtype is _F8:
        return values
    if isinstance(values, np.ma.MaskedArray):
        if np.ma.getmaskarray(values).any():
            raise ValueError(f"{what} contain masked entries")
        values = values.data
    try:
        array = np.asarray(values)
    except ValueError:
        raise ValueError(f"{what} are not an array: rows of different lengths") from None
    if array.dtype.kind == "O" and all(
        isinstance(value, (Real, Decimal)) and not isinstance(value, (bool, np.bool_)) for value in array.flat
    ):
        # Fractions, decimals, integers beyond 64 bits; an overflow becomes infinity.
        array = np.array([_convert_to_double(value) for value in array.flat]).reshape(array.shape)
    if array.dtype.kind not in "fiu":
        kind = type(values).__name__ if array.dtype.kind == "O" else array.dtype.name
        raise ValueError(f"{what} have to be real numbers, not {kind}")
    with np.errstate(over="ignore"):
        return array.astype(_F8, copy=False)


def _convert_to_double(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def vectors(values: ArrayLike, size: int, what: str) -> Array:
    """Convert values to finite vectors of length ``size``, shape (..., size).

    :raises ValueError: as :func:`doubles`; the last axis is not ``size``; a value is not finite
        (the error names its sample).
    """
    array = doubles(values, what)
    if array.shape[-1:] != (size,):
        raise ValueError(f"the last axis of {what} has to be {size}, the shape is {array.shape}")
    good = np.isfinite(array).all(-1)
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise ValueError(f"{what}{f' at sample {index}' if index else ''} is not finite")
    return array


def require_finite(result: NDArray[Any], cause: str) -> Array:
    """Return a result as float64; raise an error if an entry is not finite.

    :param cause: the input that the error names.
    :raises ValueError: an entry is not finite.
    """
    if not np.isfinite(result).all():
        raise ValueError(f"{cause} is not finite, or leads to a result that is not")
    return np.asarray(result, np.float64)


def one_vector(values: ArrayLike, size: int, what: str) -> Array:
    """Convert values to one finite vector, shape (size,); raise the errors of :func:`vectors`."""
    array = vectors(values, size, what)
    if array.ndim != 1:
        raise ValueError(f"{what} have to be those of one sample, the shape is {array.shape}")
    return array


def common_batch(*batches: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of the batch to which all inputs broadcast.

    :raises ValueError: batches of different sizes above one.
    """
    try:
        return np.broadcast_shapes(*batches)
    except ValueError:
        found = " and ".join(str(batch) for batch in dict.fromkeys(batches) if batch)
        raise ValueError(f"batches of {found} samples; expected the same of every input, or one sample") from None


def check_later(time: float, last: float | None) -> float:
    """Check that the time of a sample is later than that of the sample before; return it, s.

    :param last: time of the sample before, s; None for the first sample.
    :raises ValueError: the time is not finite, or not later.
    """
    if not math.isfinite(time):
        raise ValueError(f"the time of a sample is {time}")
    if last is not None and not time > last:
        raise ValueError(f"the time of a sample is {time:.9g} s, not later than {last:.9g} s")
    return time
