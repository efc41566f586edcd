"""Reads a scene back from its folder, or makes the folder of a new one; reports its status and whether it has work."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scas4d_core.rig_checks import rig_warnings
from scas4d_core.storage.npz import sync_folder
from server.scene.status import SceneFacts
from server.storage.definition import Definition, DefinitionError, read_definition, write_definition
from server.storage.disk import no_room
from server.storage.events import SceneCreated
from server.storage.frame_store import FrameLogIndex
from server.storage.journal import Journal
from server.storage.layout import SceneFolder
from server.storage.points import points_positions, points_sha256
from server.storage.recovery import Recovered, recover
from server.updates.reports import first_frame_facts
from server.updates.trouble import last_trouble


@dataclass(frozen=True)
class StoredScene:
    """A scene as it lies in its folder.

    Attributes:
        definition: with the settings of the reconstruction that was begun last. content: of its folder.
        points_sha256: of the initial cloud, or None. warnings: what looks wrong with the rig, a sentence each.
        first: see `first_frame_facts`. used: when its journal was last written, seconds since the epoch.
    """

    definition: Definition
    content: Recovered
    points_sha256: str | None = None
    warnings: list[str] = field(default_factory=list)
    first: Mapping[str, Any] = field(default_factory=dict)
    used: float = 0.0

    @property
    def has_work(self) -> bool:
        """True where something is to be done without anybody's asking."""
        ledger = self.content.ledger
        waits = ledger.unfinished > 0 and not ledger.paused and ledger.fatal is None
        return waits or bool(self.content.events or self.content.recompute or ledger.open)

    def facts(self, queue_limit: int) -> SceneFacts:
        """Returns the facts for its status while it is asleep. `queue_limit`: of the service, in frames."""
        ledger = self.content.ledger
        return SceneFacts(
            definition=self.definition,
            ledger=ledger,
            pictures=FrameLogIndex(self.content.folder.frames, self.content.sizes),
            has_points=self.points_sha256 is not None,
            queue_limit=self.definition.request.ingest.queue_frames or queue_limit,
            first=self.first,
            damage=list(self.content.damage),
            warnings=self.warnings,
            trouble=last_trouble(ledger),
            asleep=True,
        )


async def create_folder(folder: SceneFolder, definition: Definition) -> StoredScene:
    """Makes the folder of a new scene: its journal, and last the definition, which makes it a scene.

    Raises:
        OSError: the disk does not do; what was made is to be removed.
    """
    folder.frames.mkdir(parents=True)
    journal = Journal(folder.journal)
    try:
        await journal.append(SceneCreated(definition=definition.as_json()))
    finally:
        await journal.close()
    sync_folder(folder.path.parent)
    await asyncio.to_thread(write_definition, folder, definition)
    content = await asyncio.to_thread(recover, folder, definition.id)
    rig, settings = definition.request.rig.rig(), definition.settings.scene
    return StoredScene(definition, content, warnings=rig_warnings(rig, settings))


def read_stored_scene(
    folder: SceneFolder, bury: Callable[[Path, str], object], said: Sequence[str] = ()
) -> StoredScene:
    """Reads a scene back from its folder. Blocking.

    Args:
        folder: of the scene. said: of damage that was found before.
        bury: moves a file or folder that no reconstruction uses any more to the deleted ones, under a name.

    Raises:
        DefinitionError: the folder holds no scene that can be read. OSError: the disk does not do.
    """
    used = folder.journal.stat().st_mtime if folder.journal.exists() else 0.0
    definition, damage = read_definition(folder)
    if definition.id != folder.name:
        raise DefinitionError(f"it is of scene {definition.id}; the folder was renamed or copied")
    if damage is not None:
        write_definition(folder, definition)
    content = recover(folder, definition.id, definition.as_json())
    before = [*said, damage] if damage is not None else said
    content.damage[:0] = [sentence for sentence in dict.fromkeys(before) if sentence not in content.damage]
    folder, begun = content.folder, content.ledger.begun
    if (now := definition.with_reconstruction(begun)) is not definition:
        try:
            write_definition(folder, now)
        except OSError as error:  # the journal has it, and the next start writes it
            if not no_room(error):
                raise
    for path in folder.leftovers(begun):
        with contextlib.suppress(FileNotFoundError):  # states of a worker before: they are swept a minute after it
            bury(path, f"{folder.name}-{path.name}")
    rig, settings, positions = now.request.rig.rig(), now.settings, points_positions(folder.points)
    return StoredScene(
        now,
        content,
        points_sha256(folder.points),
        rig_warnings(rig, settings.scene) if positions is None else rig_warnings(rig, settings.scene, positions),
        first_frame_facts(content.first_report) if content.ledger.committed else {},
        used,
    )
