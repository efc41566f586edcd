"""Scene definition: rig, settings and ingest rules, stored in `scene.json`.

The file is written before the creation of the scene is acknowledged. The file is rewritten after a
restart of the reconstruction has been journalled, and when the file is found damaged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from blake3 import blake3

from client.wire import SceneCreate
from scas4d_core.errors import message_of
from scas4d_core.settings import Settings
from scas4d_core.storage.npz import open_atomically
from server.storage.events import JournalEvent, ReconstructionBegun, SceneCreated
from server.storage.journal import replay
from server.storage.layout import SceneFolder

FORMAT = 4
"""Format version of a scene folder.

Increment it with every format change of the definition, journal, frame log or points.
"""


class DefinitionError(ValueError):
    """Raised if a scene folder has no readable definition; the message states the reason."""


@dataclass(frozen=True)
class Definition:
    """A scene's creation request and resolved settings.

    `settings` are the preset's values at creation time with the request's overrides applied. If the reconstruction was
    restarted, `settings` are those of the restart and `begun` is its event.
    """

    id: str
    created: datetime
    request: SceneCreate
    settings: Settings
    begun: ReconstructionBegun | None = None

    def with_reconstruction(self, event: ReconstructionBegun | None) -> Definition:
        """Returns a definition with the settings of a restart of the reconstruction.

        The definition is returned unchanged if it already includes the restart or a later one.

        Args:
            event: event of the restart, or None if the reconstruction was never restarted.

        Raises:
            DefinitionError: the settings of the event are invalid in this version.
        """
        if event is None or (self.begun is not None and self.begun.number >= event.number):
            return self
        try:
            return replace(self, settings=Settings.model_validate(event.settings), begun=event)
        except ValueError as error:
            raise DefinitionError(f"the settings cannot be read: {message_of(error)}") from None

    def as_json(self) -> dict[str, Any]:
        """Returns the content of `scene.json`; the first journal event contains a copy."""
        return {
            "format": FORMAT,
            "id": self.id,
            "created": self.created.isoformat(),
            "request": self.request.model_dump(mode="json"),
            "settings": self.settings.model_dump(mode="json"),
            **({} if self.begun is None else {"begun": self.begun.model_dump(mode="json")}),
        }

    @classmethod
    def from_json(cls, data: Any) -> Definition:
        """Parses a definition from the output of `as_json`.

        Raises:
            DefinitionError: the definition has an unsupported format or is invalid in this version.
        """
        try:
            written = data["format"]
            if written != FORMAT:
                raise DefinitionError(
                    f"the scene has format {written}, but this version reads format {FORMAT}; "
                    "open it with the version that wrote it, or move its folder out of the data folder"
                )
            return cls(
                data["id"],
                datetime.fromisoformat(data["created"]).astimezone(UTC),
                SceneCreate.model_validate(data["request"]),
                Settings.model_validate(data["settings"]),
                reconstruction_of(data),
            )
        except DefinitionError:
            raise
        except (KeyError, TypeError, ValueError) as error:  # pydantic's error is a ValueError
            raise DefinitionError(f"the definition cannot be read: {message_of(error)}") from None


def reconstruction_of(data: Mapping[str, Any]) -> ReconstructionBegun | None:
    """Returns the restart event in the output of `as_json`, or None if the reconstruction was never restarted."""
    begun = data.get("begun")
    return None if begun is None else ReconstructionBegun.model_validate(begun)


def write_definition(folder: SceneFolder, definition: Definition) -> None:
    """Writes `scene.json`. A scene exists as soon as its folder contains this file."""
    text = json.dumps(definition.as_json(), indent=1)
    path = folder.definition
    with open_atomically(path, path.with_suffix(".part")) as file:
        file.write(json.dumps({"blake3": _digest(text), "scene": json.loads(text)}, indent=1).encode())


def read_definition(folder: SceneFolder) -> tuple[Definition, str | None]:
    """Reads the definition from `scene.json`, or from the journal if that file is damaged or missing.

    Returns:
        The definition, and a sentence that describes any damage found, or None.

    Raises:
        DefinitionError: neither file contains the definition, or it has an unsupported format or is invalid.
    """
    data, fault = _read_checked(folder)
    if fault is None:
        return Definition.from_json(data), None
    created: list[SceneCreated] = []
    replay(folder.journal, lambda event: created.append(event) if isinstance(event, SceneCreated) else None)
    if created:
        return Definition.from_json(created[0].definition), f"{fault}; read from the journal instead"
    raise DefinitionError(f"{fault}, and the journal does not contain the definition either")


def check_definition(folder: SceneFolder) -> str | None:
    """Checks `scene.json` and returns a description of its fault, or None if it is intact."""
    return _read_checked(folder)[1]


def _read_checked(folder: SceneFolder) -> tuple[Any, str | None]:
    """Returns the content of `scene.json` and None, or None and a description of the file's fault."""
    try:
        text = folder.definition.read_text(encoding="utf-8")
        data = json.loads(text)
        if _digest(_scene_text(text)) == data["blake3"]:
            return data["scene"], None
    except FileNotFoundError:
        return None, f"{folder.definition.name} is missing"
    except (OSError, KeyError, TypeError, ValueError) as error:
        return None, f"{folder.definition.name} is damaged ({message_of(error)})"
    return None, f"{folder.definition.name} is damaged (it fails its checksum)"


def _scene_text(text: str) -> str:
    """Returns the scene's JSON text within the file, as `write_definition` hashed it.

    Encoding the scene again would take longer than reading it, and a service may load hundreds of scenes at startup.
    """
    return text.partition('\n "scene": ')[2].removesuffix("\n}").replace("\n ", "\n")


def never_acknowledged(folder: SceneFolder) -> bool:
    """Returns whether a folder without `scene.json` belongs to a scene whose creation was never acknowledged.

    Such a folder contains no frames, states or points, and at most the creation event.
    """
    if folder.definition.exists() or folder.points.exists():
        return False
    if any(any(inside.glob("*")) for inside in (folder.frames, folder.states)):
        return False
    events: list[JournalEvent] = []
    replay(folder.journal, events.append)
    return len(events) < 2


def _digest(text: str) -> str:
    return blake3(text.encode()).hexdigest()
