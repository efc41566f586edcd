"""Status cache of a sleeping scene, stored in its folder so that startup does not have to read the other files.

The cache is valid only if every name, size and modification time in the scene's folder is unchanged.
"""

from __future__ import annotations

import contextlib
import json
import os
from typing import Any

from blake3 import blake3
from pydantic import ValidationError

from client import __version__
from client.wire import SceneStatus
from server.storage.definition import FORMAT
from server.storage.layout import EXPORT, SceneFolder


def write_status_cache(folder: SceneFolder, status: SceneStatus) -> None:
    """Writes the status cache of a sleeping scene. Disk errors are ignored. Blocks.

    A damaged scene gets no cache, so that every startup checks the scene again.

    Args:
        folder: scene folder.
        status: status to report while the scene is asleep.
    """
    if status.damage:
        return
    status = status.model_copy(update={"worker_deaths": 0})
    text = json.dumps({"of": _of(folder), "status": status.model_dump(mode="json")})
    beside = folder.status_cache.with_suffix(".part")
    with contextlib.suppress(OSError):
        beside.write_text(json.dumps({"blake3": blake3(text.encode()).hexdigest(), "card": text}))
        os.replace(beside, folder.status_cache)


def read_status_cache(folder: SceneFolder) -> SceneStatus | None:
    """Returns a scene's status from its cache, or None if the cache is missing or invalid. Blocks."""
    try:
        data = json.loads(folder.status_cache.read_bytes())
        if blake3(data["card"].encode()).hexdigest() != data["blake3"]:
            return None
        card = json.loads(data["card"])
        if card["of"] != _of(folder):
            return None
        status = SceneStatus.model_validate(card["status"])
    except (OSError, KeyError, TypeError, AttributeError, ValueError, ValidationError):
        return None
    return status if status.id == folder.name and status.asleep else None


def _of(folder: SceneFolder) -> dict[str, Any]:
    """Returns the service version, folder format and folder fingerprint; the cache is valid only if all match."""
    return {"version": __version__, "format": FORMAT, "content": _fingerprint(folder)}


def _fingerprint(folder: SceneFolder) -> list[Any]:
    """Returns the name, size and modification time of each entry in the folder.

    The modification time of a subfolder changes when files are added to it or removed from it.
    """
    own = {folder.status_cache.name, folder.status_cache.with_suffix(".part").name, folder.worker_lock.name}
    with os.scandir(folder.path) as entries:
        others = [entry for entry in entries if entry.name not in own and not entry.name.startswith(f"{EXPORT}.")]
        stats = [(entry.name, entry.stat()) for entry in others]
    return [[name, seen.st_size, seen.st_mtime_ns] for name, seen in sorted(stats)]
