"""Optional packages: which extra installs a module that a command is missing."""

from __future__ import annotations

from importlib.util import find_spec

SERVER = (
    *("numba", "scipy", "sklearn", "threadpoolctl", "plyfile", "pycolmap", "flip_evaluator"),
    *("fastapi", "uvicorn", "pydantic_settings", "prometheus_client", "httptools", "blake3", "python_multipart"),
)
"""Modules that the extra `server` installs."""
EXPORTS = ("gsply", "pxr")
"""Modules that the extra `exports` installs."""
RERUN = ("rerun",)
"""Modules that the extra `rerun` installs."""


def need_server() -> None:
    """Checks that the service is installed; for commands that start it in another process.

    Raises:
        ModuleNotFoundError: a module of the extra `server` is not installed.
    """
    for module in SERVER:
        if find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)


def install_hint(missing: ModuleNotFoundError) -> str | None:
    """Returns a sentence that says what to install, or None if the module belongs to no extra."""
    package = (missing.name or "").partition(".")[0]
    extras = {"server": SERVER, "exports": EXPORTS, "rerun": RERUN}
    extra = next((name for name, packages in extras.items() if package in packages), None)
    if extra is None:
        return None
    return f"this needs {package}, which is not installed; in the project's folder: pip install -e '.[{extra}]'"
