# SPDX-License-Identifier: Apache-2.0
"""Arrays of a stored map: names of their dimensions, what they are, and what they can be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

FORMAT: Final = "2"
"""Of stored maps: files of another one are rejected."""
POSITIVE: Final = {"valid_min": 0.0}
SHARE: Final = {"units": "1", "valid_min": 0.0, "valid_max": 1.0}
FLAG: Final = {"valid_min": 0, "valid_max": 1}
NONE: Final[Mapping[str, Any]] = MappingProxyType({})
"""Attributes by what a variable can be (CF conventions, 2.5.1): checked when a file is opened."""
Values = dict[str, NDArray[Any]]


def about(what: str, units: str = "", bounds: Mapping[str, Any] = NONE) -> dict[str, Any]:
    """Attributes of a variable: what it can be, its unit where it has one, and what it is."""
    return {**bounds, **({"units": units} if units else {}), "long_name": what}


@dataclass(frozen=True, eq=False)
class Variable:
    """A small array with named dimensions, held whole: coordinates and summaries."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attrs: Mapping[str, Any]


@dataclass(frozen=True)
class Field:
    """A large array that is computed chunk by chunk."""

    dims: tuple[str, ...]
    attrs: Mapping[str, Any]
    dtype: str = "f8"


def number(value: Any, what: str, units: str = "", bounds: Mapping[str, Any] = NONE) -> Variable:
    """A single number."""
    return Variable((), np.array(value), about(what, units, bounds))


def texts(dim: str, words: Iterable[str]) -> Variable:
    """Names along a dimension."""
    return Variable((dim,), np.array(list(words), "U"), {})
