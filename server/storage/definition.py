"""Definition of a scene: rig, settings, ingest rules. Written before the scene is acknowledged, and again when its
reconstruction was begun anew: the journal has that first.
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

FORMAT = 2
"""Of the folder of a scene: its definition, journal, frame log and points. Every change of one of them raises it."""


class DefinitionError(ValueError):
    """A folder has no definition that can be read: the message says why."""


@dataclass(frozen=True)
class Definition:
    """A scene as it was created. `settings` are the preset's with the request's changes, as they were then.

    Where the reconstruction was begun anew, they are the settings of that, and `begun` is its event.
    """

    id: str
    created: datetime
    request: SceneCreate
    settings: Settings
    begun: ReconstructionBegun | None = None

    def after(self, event: ReconstructionBegun | None) -> Definition:
        """The definition once the reconstruction was begun anew; the same one where it knows of the event.

        Raises:
            DefinitionError: this version does not accept its settings.
        """
        if event is None or (self.begun is not None and self.begun.number >= event.number):
            return self
        try:
            return replace(self, settings=Settings.model_validate(event.settings), begun=event)
        except ValueError as error:
            raise DefinitionError(f"the settings cannot be read: {message_of(error)}") from None

    def as_json(self) -> dict[str, Any]:
        """Returns the content of `scene.json`, and of the journal's first event."""
        return {
            "format": FORMAT,
            "id": self.id,
            "created": self.created.isoformat(),
            "request": self.request.model_dump(mode="json"),
            "settings": self.settings.model_dump(mode="json"),
            **({} if self.begun is None else {"begun": self.begun.model_dump(mode="json")}),
        }

    @classmethod
    def of_json(cls, data: Any) -> Definition:
        """Reads the definition from what `as_json` made.

        Raises:
            DefinitionError: it is of another format, or this version does not accept it.
        """
        try:
            written = data["format"]
            if written != FORMAT:
                raise DefinitionError(
                    f"the scene is of format {written}, and this version reads format {FORMAT}; "
                    "open it with the version that wrote it, or move its folder out of the data folder"
                )
            return cls(
                data["id"],
                datetime.fromisoformat(data["created"]).astimezone(UTC),
                SceneCreate.model_validate(data["request"]),
                Settings.model_validate(data["settings"]),
                begun_of(data),
            )
        except DefinitionError:
            raise
        except (KeyError, TypeError, ValueError) as error:  # pydantic's error is a ValueError
            raise DefinitionError(f"the definition cannot be read: {message_of(error)}") from None


def begun_of(data: Mapping[str, Any]) -> ReconstructionBegun | None:
    """The event in what `as_json` made; None: the reconstruction is that which came with the scene."""
    begun = data.get("begun")
    return None if begun is None else ReconstructionBegun.model_validate(begun)


def write_definition(folder: SceneFolder, definition: Definition) -> None:
    """Writes `scene.json`: the scene exists from here on."""
    text = json.dumps(definition.as_json(), indent=1)
    path = folder.definition
    with open_atomically(path, path.with_suffix(".part")) as file:
        file.write(json.dumps({"blake3": _digest(text), "scene": json.loads(text)}, indent=1).encode())


def read_definition(folder: SceneFolder) -> tuple[Definition, str | None]:
    """Reads the definition from `scene.json`, or from the journal where that file is damaged or gone.

    Returns:
        The definition, and a sentence about damage that was found, or None.

    Raises:
        DefinitionError: it is in neither of them, or it is of another format, or this version does not accept it.
    """
    data, fault = _checked(folder)
    if fault is None:
        return Definition.of_json(data), None
    created: list[SceneCreated] = []
    replay(folder.journal, lambda event: created.append(event) if isinstance(event, SceneCreated) else None)
    if created:
        return Definition.of_json(created[0].definition), f"{fault}; taken from the journal"
    raise DefinitionError(f"{fault}, and the journal does not have it either")


def check_definition(folder: SceneFolder) -> str | None:
    """Checks `scene.json`; returns its fault, or None."""
    return _checked(folder)[1]


def _checked(folder: SceneFolder) -> tuple[Any, str | None]:
    """Reads what `as_json` made from `scene.json`, and the fault of the file; with a fault there is nothing else."""
    try:
        text = folder.definition.read_text(encoding="utf-8")
        data = json.loads(text)
        if _digest(_inner(text)) == data["blake3"]:
            return data["scene"], None
    except FileNotFoundError:
        return None, f"{folder.definition.name} is gone"
    except (OSError, KeyError, TypeError, ValueError) as error:
        return None, f"{folder.definition.name} is damaged ({message_of(error)})"
    return None, f"{folder.definition.name} is damaged (it fails its checksum)"


def _inner(text: str) -> str:
    """The text of the scene within the text of the file, as `write_definition` wrote it; the digest is of that.

    To encode the scene again takes longer than to read it, and a service starts over hundreds of them.
    """
    return text.partition('\n "scene": ')[2].removesuffix("\n}").replace("\n ", "\n")


def never_acknowledged(folder: SceneFolder) -> bool:
    """True for a folder without `scene.json` whose scene was never acknowledged.

    Such a folder has no frame, no state, no points, and no event but that of its creation.
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
