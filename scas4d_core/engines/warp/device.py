"""Textual description of a Warp device."""

from __future__ import annotations

import warp as wp


def describe(name: str) -> str:
    """Returns one line with the name, memory and versions of a Warp device such as "cuda:0"."""
    device = wp.get_device(name)
    if not device.is_cuda:
        return f"kernels run on the CPU device of NVIDIA Warp {wp.config.version}"
    driver = ".".join(map(str, wp.get_cuda_driver_version()))
    return (
        f"{device.name}, {device.total_memory / 1e9:.0f} GB, {device.free_memory / 1e9:.0f} GB free, "
        f"CUDA {driver}, NVIDIA Warp {wp.config.version}"
    )
