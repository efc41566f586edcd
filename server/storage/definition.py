"""What a scene is: rig, settings, how it takes frames. Written once, before the scene is acknowledged."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from blake3 import blake3

from client.wire import SceneCreate
from scas4d_core.errors import told
from scas4d_core.settings import Settings
from scas4d_core.storage.npz import written_whole
from server.storage.events import Created, Fact
from server.storage.journal import replay

FORMAT = 1
SCENE_FILE, JOURNAL_FILE, FRAMES_FOLDER = "scene.json", "journal.log", "frames"
STATES_FOLDER, POINTS_FILE = "states", "points.npz"


class DefinitionError(ValueError):
    """A folder without a definition that can be read: says why."""


@dataclass(frozen=True)
class Definition:
    """A scene as it was created. `settings` are the preset's with the request's changes, as they were then."""

    id: str
    created: datetime
    request: SceneCreate
    settings: Settings

    def as_json(self) -> dict[str, Any]:
        """For `scene.json` and the journal."""
        return {
            "format": FORMAT,
            "id": self.id,
            "created": self.created.isoformat(),
            "request": self.request.model_dump(mode="json"),
            "settings": self.settings.model_dump(mode="json"),
        }

    @classmethod
    def of_json(cls, data: Any) -> Definition:
        """The same back.

        Raises:
            DefinitionError: it is of another format, or not what this version takes.
        """
        try:
            if data["format"] != FORMAT:
                raise DefinitionError(f"it is of format {data['format']}; this version reads format {FORMAT}")
            return cls(
                data["id"],
                datetime.fromisoformat(data["created"]).astimezone(UTC),
                SceneCreate.model_validate(data["request"]),
                Settings.model_validate(data["settings"]),
            )
        except (KeyError, TypeError, ValueError) as error:  # pydantic's error is a ValueError
            raise DefinitionError(f"the definition cannot be read: {told(error)}") from None


def write_definition(folder: Path, definition: Definition) -> None:
    """Writes `scene.json`: from here on the scene exists."""
    text = json.dumps(definition.as_json(), indent=1)
    path = folder / SCENE_FILE
    with written_whole(path, path.with_suffix(".part")) as file:
        file.write(json.dumps({"blake3": _digest(text), "scene": json.loads(text)}, indent=1).encode())


def read_definition(folder: Path) -> tuple[Definition, str | None]:
    """The definition in a scene's folder, from `scene.json` or else from the journal; and what was damaged, or None.

    Raises:
        DefinitionError: it is in neither of them.
    """
    found, said = _checked(folder)
    if isinstance(found, Definition):
        return found, None
    created: list[Created] = []
    replay(folder / JOURNAL_FILE, lambda fact: created.append(fact) if isinstance(fact, Created) else None)
    if created:
        return Definition.of_json(created[0].definition), f"{said}; taken from the journal"
    raise DefinitionError(f"{said}, and the journal does not have it either")


def check_definition(folder: Path) -> str | None:
    """What is wrong with `scene.json`, None: nothing."""
    return _checked(folder)[1]


def _checked(folder: Path) -> tuple[Definition | None, str | None]:
    """The definition in `scene.json`, or what is wrong with that."""
    try:
        data = json.loads((folder / SCENE_FILE).read_bytes())
        if _digest(json.dumps(data["scene"], indent=1)) != data["blake3"]:
            raise DefinitionError("it fails its checksum")
        return Definition.of_json(data["scene"]), None
    except FileNotFoundError:
        return None, f"{SCENE_FILE} is gone"
    except (OSError, KeyError, TypeError, ValueError) as error:
        return None, f"{SCENE_FILE} is damaged ({told(error)})"


def is_nothing(folder: Path) -> bool:
    """Whether a folder without `scene.json` is of a scene that was never acknowledged.

    Then it has no frame, no state, no points, and no fact but that of its making.
    """
    if (folder / SCENE_FILE).exists() or (folder / POINTS_FILE).exists():
        return False
    if any(any((folder / inside).glob("*")) for inside in (FRAMES_FOLDER, STATES_FOLDER)):
        return False
    facts: list[Fact] = []
    replay(folder / JOURNAL_FILE, facts.append)
    return len(facts) < 2


def _digest(text: str) -> str:
    return blake3(text.encode()).hexdigest()
