"""Optional packages, and the extra that installs each of them."""

from __future__ import annotations

from importlib.util import find_spec

SERVER = (
    *("numba", "scipy", "sklearn", "threadpoolctl", "plyfile", "pycolmap", "flip_evaluator"),
    *("fastapi", "uvicorn", "pydantic_settings", "itsdangerous"),
    *("prometheus_client", "httptools", "blake3", "python_multipart"),
)
"""Modules installed by the extra `server`."""
EXPORTS = ("gsply", "pxr")
"""Modules installed by the extra `exports`."""
RERUN = ("rerun",)
"""Modules installed by the extra `rerun`."""
EXTRAS = {
    "server": SERVER,
    "importers": ("cv2", "av"),
    "exports": EXPORTS,
    "rerun": RERUN,
    "ray": ("ray",),
    "gpu": ("warp",),
}
"""Maps each extra to the modules that it installs."""


def need_server() -> None:
    """Checks that the service's dependencies are installed, for commands that start it in another process.

    Raises:
        ModuleNotFoundError: a module of the extra `server` is not installed.
    """
    for module in SERVER:
        if find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)


def install_hint(missing: ModuleNotFoundError) -> str | None:
    """Returns an installation hint for a missing module, or None if no extra installs it."""
    package = (missing.name or "").partition(".")[0]
    extra = next((name for name, packages in EXTRAS.items() if package in packages), None)
    if extra is None:
        return None
    return (
        f"this command requires {package}, which is not installed; run in the project folder: pip install -e "
        f"'.[{extra}]'"
    )
