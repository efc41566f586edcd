"""Optional packages that only the importers need, imported on first use."""

from __future__ import annotations

import importlib
from typing import Any

INSTALL = "run in the project folder: pip install -e '.[importers]'"


class MissingExtraError(RuntimeError):
    """Raised if a package of the extra `importers` is not installed."""


def load(module: str, *, needed: str) -> Any:
    """Imports a module; `needed` states its purpose in the error message.

    Raises:
        MissingExtraError: the module is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        packages = {"cv2": "OpenCV (opencv-python-headless)", "av": "PyAV (av)"}
        raise MissingExtraError(
            f"{needed} requires {packages.get(module, module)}, which cannot be imported ({fault}); {INSTALL}"
        ) from fault


def opencv() -> Any:
    """Imports OpenCV, which undistorts images."""
    return load("cv2", needed="undistorting images")


def pyav() -> Any:
    """Imports PyAV, which decodes videos."""
    return load("av", needed="video")
