"""Layout of the data folder and of a scene's folder: names of files on disk, written here only.

The committed states inside `states/` are laid out by `scas4d_core.storage.frame_files`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class DataFolder:
    """The folder of the service, `SCAS4D_DATA`."""

    path: Path

    @property
    def lock(self) -> Path:
        """Locked by the service that works in the folder."""
        return self.path / "service.lock"

    @property
    def scenes(self) -> Path:
        """One folder a scene, by id."""
        return self.path / "scenes"

    @property
    def deleted(self) -> Path:
        """Folders of deleted scenes until they are removed."""
        return self.path / "deleted"

    def scene(self, id: str) -> SceneFolder:
        """Folder of a scene."""
        return SceneFolder(self.scenes / id)


@dataclass(frozen=True)
class SceneFolder:
    """The folder of one scene."""

    path: Path

    @property
    def name(self) -> str:
        """Name of the folder: the scene's id."""
        return self.path.name

    @property
    def definition(self) -> Path:
        """Rig and settings (`server.storage.definition`): the scene exists once this file does."""
        return self.path / "scene.json"

    @property
    def journal(self) -> Path:
        """Events of the scene (`server.storage.journal`)."""
        return self.path / "journal.log"

    @property
    def frames(self) -> Path:
        """The frame log: pictures as they were sent (`server.storage.frame_store`)."""
        return self.path / "frames"

    @property
    def states(self) -> Path:
        """Committed states (`scas4d_core.storage.history`)."""
        return self.path / "states"

    @property
    def points(self) -> Path:
        """The initial cloud, where one was given."""
        return self.path / "points.npz"

    @property
    def parts(self) -> Path:
        """Part labels, one file a number of parts (`server.processes.part_labels`)."""
        return self.path / "parts"

    @property
    def worker_lock(self) -> Path:
        """Locked by the worker process that may commit to the states."""
        return self.path / "worker.lock"

    @property
    def export(self) -> Path:
        """A 3DGS export while it is being answered."""
        return self.path / "splat.ply"
