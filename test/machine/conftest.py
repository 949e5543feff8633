# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machines of the tests' own, that answer a few states."""

import pytest

from pkm_twin import load
from pkm_twin.codegen.code import compiled


@pytest.fixture(scope="module")
def quickly_compiled():
    """Programs of a few states each, as gradients are compiled; stored under names of their own."""
    if compiled():
        from pkm_twin.codegen import llvm, native

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(native, "OPTIMISATION", native.QUICK)
            patch.setattr(llvm, "IDENTITY", f"{llvm.IDENTITY} quick")
            yield
    else:
        yield


@pytest.fixture(scope="module")
def planar():
    return load("examples/machines/rrr4_planar.yaml")
