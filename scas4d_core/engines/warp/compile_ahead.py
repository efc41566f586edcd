"""Compilation of all GPU kernels without a GPU, to check the kernels."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import warp as wp

import scas4d_core.engines.warp as package

ARCHITECTURES = (80, 89, 90, 100, 120)
"""Compute capabilities of the supported GPUs, times 10: A100, RTX 40, H100 and H200, B200, RTX 50."""


def kernel_modules() -> list[wp.Module]:
    """Returns the Warp modules that contain the engine's kernels."""
    modules = {}
    for found in pkgutil.iter_modules(package.__path__):
        python = importlib.import_module(f"{package.__name__}.{found.name}")
        kernels = [value for value in vars(python).values() if isinstance(value, wp.Kernel)]
        modules.update({kernel.module.name: kernel.module for kernel in kernels})
    return [modules[name] for name in sorted(modules)]


def compile_ahead(architecture: int, folder: Path) -> list[Path]:
    """Compiles all kernels for a GPU architecture, and returns the paths of the compiled files.

    Args:
        architecture: compute capability times 10, such as 90.
        folder: output folder.

    Raises:
        RuntimeError: if a kernel does not compile.
    """
    for module in kernel_modules():
        wp.compile_aot_module(module, device=None, arch=architecture, module_dir=str(folder), use_ptx=False)
    return sorted(folder.glob(f"*.sm{architecture}.cubin"))
