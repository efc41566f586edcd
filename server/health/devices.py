"""Whether the device of a scene can be had here, asked before the scene is made, not at its first frame."""

from __future__ import annotations

import asyncio
import sys

from server.problems import Problem

ASK = """
import sys
from scas4d_core.torch_backend.device import DeviceError, require_device
try:
    require_device(sys.argv[1])
except DeviceError as error:
    print(error)
    sys.exit(3)
"""
"""In a process of its own: torch takes hundreds of megabytes, and the service has no use for it."""
REFUSED = 3
PATIENCE_S = 120.0

_found: set[str] = {"cpu"}


async def require(device: str) -> None:
    """Returns where updates can run on the device.

    Raises:
        Problem: 422, it is not there; the remedy says what to install. 503, no answer in time.
    """
    if device in _found:
        return
    asking = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", ASK, device), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    try:
        said, faults = await asyncio.wait_for(asking.communicate(), PATIENCE_S)
    except TimeoutError:
        raise Problem(
            503,
            f"whether there is a device {device!r} is not known after {PATIENCE_S:g} s",
            field="settings.device",
            value=device,
            remedy="ask again, or choose device 'cpu'",
        ) from None
    finally:
        if asking.returncode is None:
            asking.kill()
    if asking.returncode == 0:
        _found.add(device)
        return
    text = (said if asking.returncode == REFUSED else faults.strip().rpartition(b"\n")[2]).decode(errors="replace")
    fault, _, remedy = text.strip().rpartition("; ")
    raise Problem(
        422,
        fault or f"device {device!r} cannot be had: {text.strip()}",
        field="settings.device",
        value=device,
        remedy=remedy if fault else "choose device 'cpu'",
    )
