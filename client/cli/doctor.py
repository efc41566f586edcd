"""Checks of the machine for `scas4d doctor`: Python, CPU cores, extras, disk and GPU."""

from __future__ import annotations

import platform
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from client import __version__
from client.cli import extras

LEAST_FREE_GB = 5
"""Free disk space in GB below which a warning is printed."""
DRIVER_FILE = Path("/proc/driver/nvidia/version")
"""File in which the NVIDIA driver reports its version on Linux."""
LEAST_DRIVER = 580
"""Oldest NVIDIA driver supported by the NVIDIA Warp packages; Warp's release page has builds for older drivers."""


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: name of the checked item.
        text: result of the check, with a remedy if something is missing.
        fault: whether the check found a problem that prevents the service from running.
    """

    name: str
    text: str
    fault: bool = False


def checks(data: Path) -> Iterator[Check]:
    """Yields the checks of the machine.

    Args:
        data: data folder of the service, which need not exist yet.
    """
    from scas4d_core.machine import usable_cores

    cores = usable_cores()
    python = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}, {cores} cores"
    yield Check("scas4d", f"{__version__}, {python}")
    yield from installed()
    yield disk(data)
    yield gpu()


def installed() -> Iterator[Check]:
    """Yields one check per extra; only a missing `server` is a fault."""
    for extra, modules in extras.EXTRAS.items():
        missing = [module for module in modules if find_spec(module) is None]
        if missing:
            text = f"not installed ({', '.join(missing)}); run in the project folder: pip install -e '.[{extra}]'"
            yield Check(f"extra {extra}", text, fault=extra == "server")
        else:
            yield Check(f"extra {extra}", "installed")


def disk(data: Path) -> Check:
    """Checks the free disk space for the data folder; little space is not a fault."""
    existing = next(folder for folder in (data.resolve(), *data.resolve().parents) if folder.exists())
    free = shutil.disk_usage(existing).free / 1e9
    small = (
        "; one day of frames needs more (see docs/operations.md): choose another disk with --data"
        if free < LEAST_FREE_GB
        else ""
    )
    return Check("disk", f"{free:.0f} GB free for {data}{small}")


def gpu() -> Check:
    """Checks whether scenes with the device 'auto' use a GPU, or what is missing for it."""
    from scas4d_core.engines.choose import gpu_fault, warp_device

    driver = driver_version(DRIVER_FILE.read_text()) if DRIVER_FILE.exists() else None
    if fault := gpu_fault():
        old = driver is not None and driver[0] < LEAST_DRIVER
        remedy = (
            f"; NVIDIA Warp requires driver {LEAST_DRIVER}, found {'.'.join(map(str, driver or ()))}" if old else ""
        )
        return Check("GPU", f"not used: {fault}{remedy}; scenes run on the CPU (see docs/gpu.md)")
    from scas4d_core.engines.warp.device import describe

    return Check("GPU", describe(warp_device()))


def driver_version(text: str) -> tuple[int, ...] | None:
    """Parses the driver version from the text of ``DRIVER_FILE``; returns None if it contains none.

    >>> driver_version("NVRM version: NVIDIA UNIX x86_64 Kernel Module  580.159.04  Tue Jan  6")
    (580, 159, 4)
    """
    found = re.search(r"\b(\d{3,})\.(\d+)(?:\.(\d+))?\b", text)
    return None if found is None else tuple(int(part) for part in found.groups() if part is not None)


def run(data: Path) -> int:
    """Prints all checks; returns 1 if the service cannot run, else 0."""
    results = list(checks(data))
    width = max(len(check.name) for check in results)
    for check in results:
        print(f"{check.name:<{width}}  {'missing: ' if check.fault else ''}{check.text}")
    return int(any(check.fault for check in results))
