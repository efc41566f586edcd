"""Layout of the data folder and of a scene's folder: names of files on disk, written here only.

The committed states inside `states/` are laid out by `scas4d_core.storage.frame_files`.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from scas4d_core.storage.npz import sync_folder
from server.storage.events import ReconstructionBegun


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

    @property
    def exports(self) -> Path:
        """One folder a scene, by id, with a folder an export; emptied when the service starts."""
        return self.path / "exports"

    def scene(self, id: str) -> SceneFolder:
        """Folder of a scene."""
        return SceneFolder(self.scenes / id)

    def bury(self, path: Path, name: str) -> Path:
        """Moves a file or a folder to the deleted ones; returns its new path. Blocking."""
        grave = self.deleted / f"{name}-{secrets.token_hex(4)}"
        path.rename(grave)
        sync_folder(self.deleted)
        sync_folder(path.parent)
        return grave

    def sweep(self) -> None:
        """Removes what was moved to the deleted ones. Blocking."""
        for path in self.deleted.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    path.unlink()


EXPORT = "export"
"""Begins the names of exports while they are being answered."""


@dataclass(frozen=True)
class SceneFolder:
    """The folder of one scene. Whatever a reconstruction makes has its number in its name, but for the first, 0.

    Attributes:
        reconstruction: its number. cloud: number of the reconstruction whose points it begins from.
        epoch: of the worker that commits to the states (`server.storage.fencing`); None: of the scene's process.
    """

    path: Path
    reconstruction: int = 0
    cloud: int = 0
    epoch: int | None = None

    def begun(self, event: ReconstructionBegun | None) -> SceneFolder:
        """The folder with the names of the reconstruction that was begun last; None: the one that came with the scene.

        Without points it is as if they were its own, and there are none (`leftovers`).
        """
        if event is None:
            return self
        return replace(self, reconstruction=event.number, cloud=event.number if event.points is None else event.points)

    def leftovers(self, event: ReconstructionBegun | None) -> list[Path]:
        """Lists what reconstructions before the one that was begun last left, and points that it does not use."""
        if event is None:
            return []
        made = [replace(self, reconstruction=number) for number in range(event.number)]
        points = [self.points_of(number) for number in range(event.number + 1) if number != event.points]
        paths = [path for folder in made for path in (folder.states, folder.parts)] + points
        paths += [path for folder in made for path in sorted(self.path.glob(f"{folder.states.name}.*"))]
        return [path for path in paths if path.exists() or path.is_symlink()]

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
        """Committed states (`scas4d_core.storage.history`); a folder, or a link to that of an epoch."""
        states = self._of("states")
        return states if self.epoch is None else epoch_folder(states, self.epoch)

    @property
    def points(self) -> Path:
        """The initial cloud, where one was given."""
        return self.points_of(self.cloud)

    def points_of(self, reconstruction: int) -> Path:
        """The initial cloud that was sent for a reconstruction."""
        return self.path / f"points{_suffix(reconstruction)}.npz"

    @property
    def parts(self) -> Path:
        """Part labels, one file a number of parts (`server.processes.part_labels`)."""
        return self._of("parts")

    def _of(self, name: str) -> Path:
        return self.path / f"{name}{_suffix(self.reconstruction)}"

    @property
    def card(self) -> Path:
        """Status of a scene that is asleep (`server.scene.status_cache`); nothing is lost with it."""
        return self.path / "asleep.json"

    @property
    def worker_lock(self) -> Path:
        """Locked by the worker process that may commit to the states."""
        return self.path / "worker.lock"

    def export(self, word: str) -> Path:
        """An export while it is being answered; `word`: of the reader, as one that was given up may go on."""
        return self.path / f"{EXPORT}.{word}.part"


def _suffix(reconstruction: int) -> str:
    return f"_{reconstruction}" if reconstruction else ""


def epoch_folder(states: Path, epoch: int) -> Path:
    """Folder of the states of an epoch.

    >>> epoch_folder(Path("a/states"), 3).name
    'states.3'
    """
    return states.with_name(f"{states.name}.{epoch}")
