"""Checks that the device of the settings is available."""

from __future__ import annotations

import importlib.util


class DeviceError(RuntimeError):
    """A device cannot be had; the text is "fault; remedy".

    Attributes:
        fault: what is missing. remedy: what to install or choose.
    """

    def __init__(self, fault: str, remedy: str) -> None:
        super().__init__(f"{fault}; {remedy}")
        self.fault, self.remedy = fault, remedy


def require_device(device: str) -> None:
    """Raises unless an update can run on ``device``.

    Args:
        device: "cpu" or "cuda".

    Raises:
        DeviceError: "cuda" without torch, gsplat, a torch built for CUDA, a GPU, or the compiler that gsplat needs.

    >>> require_device("cpu")
    >>> require_device("cuda")  # doctest: +SKIP
    Traceback (most recent call last):
    scas4d_core.torch_backend.device.DeviceError: device 'cuda': ...; or choose device 'cpu'
    """
    if device == "cpu":
        return
    otherwise = "or choose device 'cpu'"
    for package in ("torch", "gsplat"):
        if importlib.util.find_spec(package) is None:
            raise DeviceError(
                f"device {device!r}: {package} is not installed", f"run pip install -e '.[cuda]', {otherwise}"
            )
    import torch

    if torch.version.cuda is None:
        raise DeviceError(
            f"device {device!r}: torch {torch.__version__} is built without CUDA",
            f"install a CUDA build from pytorch.org, {otherwise}",
        )
    if not torch.cuda.is_available():
        raise DeviceError(
            f"device {device!r}: torch {torch.__version__} finds no GPU",
            f"see whether nvidia-smi lists one and its driver knows CUDA {torch.version.cuda}, {otherwise}",
        )
    from torch.utils.cpp_extension import CUDA_HOME

    if CUDA_HOME is None and importlib.util.find_spec("gsplat.csrc") is None:
        raise DeviceError(
            f"device {device!r}: gsplat compiles its kernels at first use and finds no nvcc",
            f"install the CUDA toolkit {torch.version.cuda} and set CUDA_HOME to it, {otherwise}",
        )
