# SPDX-License-Identifier: Apache-2.0
"""Whether a stored map is whole, and whether its numbers can be what they are said to be.

HDF5 protects data alone: a flipped bit in its own structures may pass for another number. So
the SHA-256 of the file stands at its end, where HDF5 does not look.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from xarray import Dataset

SEALED: Final = {"checksum": "SHA-256 of all before, in the last 32 bytes"}
"""The attribute of a file that has its checksum at the end."""
ROUNDING: Final = 1e-9
"""By how much a number may be beyond its bounds: they are of order 1."""
_MARK: Final = b"\npkm_twin atlas SHA-256\n"
_SEAL: Final = len(_MARK) + hashlib.sha256().digest_size
_BLOCK: Final = 1 << 20
_SLAB: Final = 1 << 22
"""Numbers of a variable that are judged at once, about."""


def seal(file: BinaryIO) -> None:
    """Write the checksum of a whole file at its end."""
    size = file.seek(0, 2)
    digest = _digest(file, size)
    file.seek(size)
    # One write may take less than all.
    rest = memoryview(_MARK + digest)
    while rest:
        rest = rest[file.write(rest) :]


def seal_holds(path: Path) -> bool | None:
    """Whether the checksum at a file's end is that of the file; None where there is none."""
    with path.open("rb") as file:
        size = file.seek(0, 2) - _SEAL
        if size < 0:
            return None
        file.seek(size)
        mark, digest = file.read(len(_MARK)), file.read()
        return digest == _digest(file, size) if mark == _MARK else None


def _digest(file: BinaryIO, size: int) -> bytes:
    file.seek(0)
    found = hashlib.sha256()
    while size > 0 and (block := file.read(min(size, _BLOCK))):
        found.update(block)
        size -= len(block)
    return found.digest()


def nonsense(data: Dataset) -> str:
    """What is wrong with the numbers of a map, for an error; empty where nothing is.

    Axes and other coordinates are finite, axes never decrease, nothing is infinite. All numbers
    are within ``valid_min`` and ``valid_max`` (CF conventions, 2.5.1), or NaN in fields.
    """
    for name, variable in data.variables.items():
        if variable.dtype.kind not in "fiu" or not variable.size:
            continue
        low, high = (
            float(variable.attrs.get(f"valid_{end}", bound))
            for end, bound in (("min", -math.inf), ("max", math.inf))
        )
        for values in _slabs(variable):
            if name in data.coords and np.isnan(values).any():
                return f"{name} has the value nan"
            # The least and the greatest number; NaN where there is none.
            for value in (np.fmin.reduce(values, None), np.fmax.reduce(values, None)):
                if math.isinf(value) or value < low - ROUNDING or value > high + ROUNDING:
                    return f"{name} has the value {value:g}, allowed: {low:g} to {high:g}"
            if variable.dims == (name,) and (np.diff(values) < 0).any():
                return f"the axis {name} decreases"
    return ""


def _slabs(variable: Any) -> Iterator[NDArray[Any]]:
    """All numbers of a variable: at once where they are few, else along its first two axes."""
    if variable.size <= _SLAB or variable.ndim < 2:
        yield np.asarray(variable.values)
        return
    first, second, *rest = variable.shape
    rows = max(1, _SLAB // math.prod(rest))
    for k in range(first):
        for start in range(0, second, rows):
            yield np.asarray(variable[k, start : start + rows].values)
