"""Checks that the device of a scene can be had, before the scene is made and not at its first frame."""

from __future__ import annotations

import asyncio
import json
import sys

from server.problems import Problem

ASK = """
import json, sys
from scas4d_core.engines.torch.device import DeviceError, require_device
try:
    require_device(sys.argv[1])
except DeviceError as error:
    print(json.dumps([error.fault, error.remedy]))
    sys.exit(3)
"""
"""Runs in a process of its own: torch takes hundreds of megabytes, and the service has no use for it."""
REFUSED = 3
"""Exit status of that process where the device cannot be had: fault and remedy are on its stdout."""
PATIENCE_S = 120.0

_found: set[str] = {"cpu"}


async def require(device: str) -> None:
    """Returns if updates can run on the device.

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
            f"it is not known yet if there is a device {device!r}, after {PATIENCE_S:g} s",
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
    if asking.returncode == REFUSED:
        fault, remedy = json.loads(said)
    else:
        last = faults.decode(errors="replace").strip().rpartition("\n")[2]
        fault, remedy = f"device {device!r} cannot be had: {last}", "choose device 'cpu'"
    raise Problem(422, fault, field="settings.device", value=device, remedy=remedy)
