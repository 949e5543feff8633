# SPDX-License-Identifier: Apache-2.0
"""Packages that only some commands need, imported on first use."""

from __future__ import annotations

import importlib
from typing import Any

from pkm_twin.errors import PkmTwinError, install


class MissingExtraError(PkmTwinError, ImportError):
    """A package that is not installed; ``extra`` is the extra of pkm_twin that brings it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; {install(extra)} brings it")
        self.package = package
        self.extra = extra


def require(module: str, extra: str) -> Any:
    """Import a module of an extra.

    :raises MissingExtraError: naming the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingExtraError(module.partition(".")[0], extra) from None
