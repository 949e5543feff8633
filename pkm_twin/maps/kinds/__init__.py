# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Collect the kinds of maps: one per file of this folder, and entry points of other packages."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import Final

from pkm_twin.extensions import Extensible
from pkm_twin.maps.kind import Kind

BUILTIN_KINDS: Final[dict[str, type[Kind]]] = {
    one.name: one
    for module in pkgutil.iter_modules(__path__)
    for one in vars(import_module(f"{__name__}.{module.name}")).values()
    if isinstance(one, type) and issubclass(one, Kind) and "name" in vars(one)
}
"""This package's kinds of maps, by name."""
KINDS: Final[Extensible[type[Kind]]] = Extensible("pkm_twin.maps", Kind, BUILTIN_KINDS, BUILTIN_KINDS.__getitem__)
