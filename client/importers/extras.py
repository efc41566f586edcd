"""Optional packages of the extra `importers`, which are imported on first use."""

from __future__ import annotations

import importlib
from typing import Any

INSTALL = "run in the project folder: pip install -e '.[importers]'"


class MissingExtraError(RuntimeError):
    """Raised if a package of the extra `importers` is not installed."""


def load(module: str, *, needed: str) -> Any:
    """Imports and returns a module.

    Args:
        module: name of the module.
        needed: purpose of the module, for the error message.

    Raises:
        MissingExtraError: if the module cannot be imported. The message contains the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        packages = {"cv2": "OpenCV (opencv-python-headless)", "av": "PyAV (av)", "yaml": "PyYAML (pyyaml)"}
        raise MissingExtraError(
            f"{needed} requires {packages.get(module, module)}, which cannot be imported ({fault}); {INSTALL}"
        ) from fault


def opencv() -> Any:
    """Imports and returns OpenCV, which undistorts images."""
    return load("cv2", needed="undistorting images")


def pyav() -> Any:
    """Imports and returns PyAV, which decodes and encodes videos."""
    return load("av", needed="video")
