"""Scene as stored in its folder: creates the folder of a new scene, or loads an existing scene."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scas4d_core.rig_checks import rig_warnings
from scas4d_core.storage.npz import sync_folder
from server.keep_up import queue_limit
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
    """Scene as stored in its folder.

    Attributes:
        definition: scene definition, with the settings of the latest reconstruction.
        content: contents recovered from the folder.
        points_sha256: SHA-256 of the uploaded initial point cloud, or None.
        warnings: warnings about the rig.
        first: facts about the first frame; see `first_frame_facts`.
        used: time of the last journal write, in seconds since the epoch.
    """

    definition: Definition
    content: Recovered
    points_sha256: str | None = None
    warnings: list[str] = field(default_factory=list)
    first: Mapping[str, Any] = field(default_factory=dict)
    used: float = 0.0

    @property
    def has_work(self) -> bool:
        """Whether the scene has pending work that does not depend on a request."""
        ledger = self.content.ledger
        waits = ledger.unfinished > 0 and not ledger.paused and ledger.fatal is None
        return waits or bool(self.content.events or self.content.recompute or ledger.open)

    def facts(self, default_queue: int) -> SceneFacts:
        """Returns the data used to compute the sleeping scene's status.

        `default_queue` is the service's default maximum number of queued frames.
        """
        ledger = self.content.ledger
        return SceneFacts(
            definition=self.definition,
            ledger=ledger,
            pictures=FrameLogIndex(self.content.folder.frames, self.content.sizes),
            has_points=self.points_sha256 is not None,
            queue_limit=queue_limit(self.definition.request.ingest, default_queue),
            first=self.first,
            damage=list(self.content.damage),
            warnings=self.warnings,
            trouble=last_trouble(ledger),
            asleep=True,
        )


async def create_folder(folder: SceneFolder, definition: Definition) -> StoredScene:
    """Creates the folder of a new scene with its journal and, as the last step, its definition.

    Raises:
        OSError: a disk operation failed; the caller must remove the folder.
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
    """Loads a scene from its folder. Blocks.

    Args:
        folder: scene folder.
        bury: function that moves an unneeded file or folder to the `deleted` folder under the given name.
        said: messages about damage that was found earlier.

    Raises:
        DefinitionError: the folder does not contain a readable scene.
        OSError: a disk operation failed.
    """
    used = folder.journal.stat().st_mtime if folder.journal.exists() else 0.0
    definition, damage = read_definition(folder)
    if definition.id != folder.name:
        raise DefinitionError(f"the folder contains scene {definition.id}; it was renamed or copied")
    if damage is not None:
        write_definition(folder, definition)
    content = recover(folder, definition.id, definition.as_json())
    before = [*said, damage] if damage is not None else said
    content.damage[:0] = [sentence for sentence in dict.fromkeys(before) if sentence not in content.damage]
    folder, begun = content.folder, content.ledger.begun
    if (now := definition.with_reconstruction(begun)) is not definition:
        try:
            write_definition(folder, now)
        except OSError as error:  # a full disk is harmless: the next load writes the file from the journal
            if not no_room(error):
                raise
    for path in folder.leftovers(begun):
        with contextlib.suppress(FileNotFoundError):  # states of an earlier worker may be removed concurrently
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
