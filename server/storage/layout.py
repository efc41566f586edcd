"""Layout of the data folder and of the scene folders; all file names on disk are defined here.

The layout of the committed states inside `states/` is defined in `scas4d_core.storage.frame_files`.
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
    """Data folder of the service, `SCAS4D_DATA`."""

    path: Path

    @property
    def lock(self) -> Path:
        """Lock file of the service that uses the folder."""
        return self.path / "service.lock"

    @property
    def scenes(self) -> Path:
        """Folder with one subfolder per scene, named by scene ID."""
        return self.path / "scenes"

    @property
    def deleted(self) -> Path:
        """Folder for deleted scenes and other unneeded files until they are removed from disk."""
        return self.path / "deleted"

    @property
    def exports(self) -> Path:
        """Folder of exports, which is emptied at startup.

        The folder contains one subfolder per scene, named by scene ID. The subfolder of a scene
        contains one folder per export.
        """
        return self.path / "exports"

    def scene(self, id: str) -> SceneFolder:
        """Returns the folder of a scene."""
        return SceneFolder(self.scenes / id)

    def move_to_deleted(self, path: Path, name: str) -> Path:
        """Moves a file or folder into the `deleted` folder and returns its new path. Blocks."""
        grave = self.deleted / f"{name}-{secrets.token_hex(4)}"
        path.rename(grave)
        sync_folder(self.deleted)
        sync_folder(path.parent)
        return grave

    def remove_deleted(self) -> None:
        """Removes everything in the `deleted` folder from disk. Blocks."""
        for path in self.deleted.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    path.unlink()


EXPORT = "export"
"""Name prefix of the temporary files of exports that are streamed to a client."""


@dataclass(frozen=True)
class SceneFolder:
    """Folder of one scene.

    The names of files that belong to a reconstruction other than number 0 contain the number of the
    reconstruction.

    Attributes:
        path: folder path.
        reconstruction: reconstruction number.
        cloud: number of the reconstruction whose initial points are used.
        epoch: epoch of the worker that commits to the states (`server.storage.fencing`), or None to access the states
            through the `states` path.
    """

    path: Path
    reconstruction: int = 0
    cloud: int = 0
    epoch: int | None = None

    def of_reconstruction(self, event: ReconstructionBegun | None) -> SceneFolder:
        """Returns this folder with the file names of a restarted reconstruction; unchanged if `event` is None.

        If the reconstruction has no initial points, `points` is the path of its own points, which does not exist.
        """
        if event is None:
            return self
        return replace(self, reconstruction=event.number, cloud=event.number if event.points is None else event.points)

    def leftovers(self, event: ReconstructionBegun | None) -> list[Path]:
        """Returns existing paths of earlier reconstructions, including points that the current one does not use."""
        if event is None:
            return []
        made = [replace(self, reconstruction=number) for number in range(event.number)]
        points = [self.points_of(number) for number in range(event.number + 1) if number != event.points]
        paths = [path for folder in made for path in (folder.states, folder.parts)] + points
        paths += [path for folder in made for path in sorted(self.path.glob(f"{folder.states.name}.*"))]
        return [path for path in paths if path.exists() or path.is_symlink()]

    @property
    def name(self) -> str:
        """Name of the folder, which is the scene ID."""
        return self.path.name

    @property
    def definition(self) -> Path:
        """File with the rig and settings (`server.storage.definition`); the scene exists once this file does."""
        return self.path / "scene.json"

    @property
    def journal(self) -> Path:
        """File with the scene's events (`server.storage.journal`)."""
        return self.path / "journal.log"

    @property
    def frames(self) -> Path:
        """Frame log with the images as they were uploaded (`server.storage.frame_store`)."""
        return self.path / "frames"

    @property
    def states(self) -> Path:
        """Committed states (`scas4d_core.storage.history`): a folder, or a link to the folder of an epoch."""
        states = self._of("states")
        return states if self.epoch is None else epoch_folder(states, self.epoch)

    @property
    def points(self) -> Path:
        """File with the initial point cloud, if one was given."""
        return self.points_of(self.cloud)

    def points_of(self, reconstruction: int) -> Path:
        """Returns the path of the initial point cloud that was uploaded for a reconstruction."""
        return self.path / f"points{_suffix(reconstruction)}.npz"

    @property
    def parts(self) -> Path:
        """Folder of part labels, one file per number of parts (`server.processes.part_labels`)."""
        return self._of("parts")

    def _of(self, name: str) -> Path:
        return self.path / f"{name}{_suffix(self.reconstruction)}"

    @property
    def status_cache(self) -> Path:
        """Cached status of a sleeping scene (`server.scene.status_cache`), which can always be rebuilt."""
        return self.path / "asleep.json"

    @property
    def worker_lock(self) -> Path:
        """Lock file of the worker process that may commit to the states."""
        return self.path / "worker.lock"

    def export(self, word: str) -> Path:
        """Returns the path of the temporary file of an export in progress.

        `word` must be unique per reader, because an abandoned reader may still be writing.
        """
        return self.path / f"{EXPORT}.{word}.part"


def _suffix(reconstruction: int) -> str:
    return f"_{reconstruction}" if reconstruction else ""


def epoch_folder(states: Path, epoch: int) -> Path:
    """Returns the path of the folder with the states of an epoch.

    >>> epoch_folder(Path("a/states"), 3).name
    'states.3'
    """
    return states.with_name(f"{states.name}.{epoch}")
