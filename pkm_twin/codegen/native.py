# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machine code for this processor, from text of LLVM's intermediate language."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Any, Final

import llvmlite.binding as binding

SYMBOL: Final = "kernel"
PREPARE: Final = "prepare"
OPTIMISATION: Final = 1
"""LLVM's level: the next one takes up to four times as long for code that is no faster."""
QUICK: Final = 0
"""Of programs that are ``quick``: gradients, which take far longer to compile than to run."""


def _initialise() -> None:
    # Older releases of llvmlite need it, newer ones refuse it.
    with suppress(RuntimeError):
        binding.initialize()
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    # The scheduler compares each load with each store of a region, and ours are long: half of the
    # compile time. Split sooner, the code has the same size and speed. Releases that are not
    # known may end the process for an option that they lack.
    if (14,) <= binding.llvm_version_info < (23,):
        binding.set_option("", "-dag-maps-huge-region=200")
        binding.set_option("", "-dag-maps-reduction-size=100")


_initialise()

CPU: Final[str] = binding.get_host_cpu_name()


def _features() -> str:
    try:
        text: str = binding.get_host_cpu_features().flatten()
    except RuntimeError:  # not every processor tells
        return ""
    return text


FEATURES: Final = _features()
FUSED: Final = "+fma" in FEATURES.split(",") or "aarch64" in binding.get_process_triple()


def compile_object(text: str, level: int = OPTIMISATION) -> bytes:
    """Machine code for this processor."""
    module = binding.parse_assembly(text)
    module.verify()
    # No passes before: of straight lines without repetition they make nothing faster, and take
    # as long as all the rest.
    code: bytes = _machine(level).emit_object(module)
    return code


_ENGINES: Final[list[Any]] = []


def load_object(code: bytes) -> tuple[Any, Any]:
    """Addresses of both functions, to be called with the address of their words."""
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return tuple(engine.get_function_address(name) for name in (PREPARE, SYMBOL))


def _machine(level: int = OPTIMISATION) -> Any:
    target = binding.Target.from_default_triple()
    return target.create_target_machine(
        cpu=CPU, features=FEATURES, opt=level, jit=True, reloc="pic"
    )


PROTOTYPE: Final = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""For batches: other threads run meanwhile."""


LOCKED: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""For one sample: letting the lock go costs more than the sample."""
