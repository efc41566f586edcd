"""Description of the device that runs the kernels."""

from __future__ import annotations

import warp as wp


def describe(name: str) -> str:
    """Returns the name, memory and versions of a Warp device, such as "cuda:0", in one line."""
    device = wp.get_device(name)
    if not device.is_cuda:
        return f"kernels run on the CPU device of NVIDIA Warp {wp.config.version}"
    driver = ".".join(map(str, wp.get_cuda_driver_version()))
    return (
        f"{device.name}, {device.total_memory / 1e9:.0f} GB, {device.free_memory / 1e9:.0f} GB free, "
        f"CUDA {driver}, NVIDIA Warp {wp.config.version}"
    )
