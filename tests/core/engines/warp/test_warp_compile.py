"""All kernels compile for GPUs, without one."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

from scas4d_core.engines.warp.compile_ahead import ARCHITECTURES, compile_ahead, kernel_modules


@pytest.mark.parametrize("architecture", [ARCHITECTURES[0], ARCHITECTURES[-1]])
def test_all_kernels_compile_for_the_oldest_and_the_newest_gpu(architecture: int, tmp_path: Path) -> None:
    files = compile_ahead(architecture, tmp_path)
    assert len(files) == len(kernel_modules()) > 10
    assert all(file.read_bytes().startswith(b"\x7fELF") for file in files)


def test_no_kernel_is_left_out() -> None:
    names = {kernel.key for module in kernel_modules() for kernel in module.kernels.values()}
    assert {"project", "blend_backward", "sort_lists", "map_clusters_backward", "shade", "step_parameters"} <= names
