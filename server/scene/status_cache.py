"""The card of a sleeping scene: its status beside its folder's other files, so that a start need not read those.

A card is worth no more than the time it saves: it is believed only while every name, size and time of change in the
scene's folder is what it was, and ignored otherwise.
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
    """Writes the card of a scene that has fallen asleep, or was found asleep. Blocking; a full disk costs no more.

    A scene with damage gets none: each start looks again.

    Args:
        folder: of the scene. status: as reported while the scene sleeps.
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
    """Reads a scene's status from its card; None where there is none that can be believed. Blocking."""
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
    """Version of the service, format of the folder, and its content: a card of another one is not believed."""
    return {"version": __version__, "format": FORMAT, "content": _fingerprint(folder)}


def _fingerprint(folder: SceneFolder) -> list[Any]:
    """Names, sizes and times of change of what lies in the folder; those of a folder in it change with its names."""
    own = {folder.status_cache.name, folder.status_cache.with_suffix(".part").name, folder.worker_lock.name}
    with os.scandir(folder.path) as entries:
        others = [entry for entry in entries if entry.name not in own and not entry.name.startswith(f"{EXPORT}.")]
        stats = [(entry.name, entry.stat()) for entry in others]
    return [[name, seen.st_size, seen.st_mtime_ns] for name, seen in sorted(stats)]
