# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compile LLVM assembly to machine code for this processor, and load it."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Any, Final

import llvmlite.binding as binding

SYMBOL: Final = "kernel"
PREPARE: Final = "prepare"
OPTIMISATION: Final = 1
"""LLVM's optimisation level: level 2 compiles up to four times as long for code no faster."""
QUICK: Final = 0
"""Level for ``quick`` programs (gradients), which take far longer to compile than to run."""


def _initialise() -> None:
    # Older releases of llvmlite need this call, newer ones raise an error.
    with suppress(RuntimeError):
        binding.initialize()
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    # Scheduling compares each load with each store of a region: for long regions half of the compile
    # time. Shorter regions give code of the same size and speed. Set the option only for releases
    # that are known to have it, because LLVM ends the process for an unknown option.
    if (14,) <= binding.llvm_version_info < (23,):
        binding.set_option("", "-dag-maps-huge-region=200")
        binding.set_option("", "-dag-maps-reduction-size=100")


_initialise()

CPU: Final[str] = binding.get_host_cpu_name()


def _host_features() -> str:
    try:
        text: str = binding.get_host_cpu_features().flatten()
    except RuntimeError:  # LLVM cannot read the features of every processor
        return ""
    return text


FEATURES: Final = _host_features()
FUSED: Final = "+fma" in FEATURES.split(",") or "aarch64" in binding.get_process_triple()


def compile_object(text: str, level: int = OPTIMISATION) -> bytes:
    """Compile LLVM assembly to an object file for this processor."""
    module = binding.parse_assembly(text)
    module.verify()
    # No optimisation passes before: straight-line code gains nothing, and they double the time.
    code: bytes = _make_target_machine(level).emit_object(module)
    return code


_ENGINES: Final[list[Any]] = []


def load_object(code: bytes) -> tuple[Any, Any]:
    """Load an object file; return the addresses of ``prepare`` and ``kernel``."""
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _make_target_machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    return tuple(engine.get_function_address(name) for name in (PREPARE, SYMBOL))


def _make_target_machine(level: int = OPTIMISATION) -> Any:
    target = binding.Target.from_default_triple()
    return target.create_target_machine(cpu=CPU, features=FEATURES, opt=level, jit=True, reloc="pic")


LOCK_RELEASING_PROTOTYPE: Final = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""Function type for batches: releases the interpreter lock during the call."""


LOCK_KEEPING_PROTOTYPE: Final = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
"""Function type for one sample: keeps the lock, as releasing it costs more than the sample."""
