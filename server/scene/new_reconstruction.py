"""Restart of a scene's reconstruction: validation of the request, and the event that starts it."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass

from client.wire import FrameState, ReconstructionRequest
from scas4d_core.cameras import Rig
from scas4d_core.rig_checks import RigError, check_start
from scas4d_core.settings import Settings
from server.problems import Problem, count_noun, rig_problem
from server.storage.definition import read_definition
from server.storage.disk import full_disk, no_room
from server.storage.events import ReconstructionBegun
from server.storage.frame_table import FrameEntry
from server.storage.journal import Journal
from server.storage.layout import SceneFolder
from server.storage.ledger import Ledger
from server.storage.recovery import recover

log = logging.getLogger("scas4d.server")


def restart_remedy(ledger: Ledger) -> str:
    """Returns the remedy for a failed scene, which is to restart its reconstruction."""
    number = ledger.reconstruction + 1
    return (
        f"restart its reconstruction: PUT /v1/scenes/{ledger.scene}/reconstructions/{number}, "
        f"or scas4d begin-again {ledger.scene}"
    )


def restarting_problem(id: str) -> Problem:
    """Returns the 503 problem for a scene whose reconstruction is being restarted."""
    fault = "the reconstruction of this scene is being restarted"
    return Problem(503, fault, field="id", value=id, remedy="try again", headers={"Retry-After": "1"})


@dataclass(frozen=True)
class NewReconstruction:
    """Reconstruction that will replace the current one of a scene.

    Args:
        number: number of the new reconstruction.
        request: request to restart the reconstruction.
        settings: validated scene settings, including the changes in the request.
        rig: the scene's rig.
    """

    number: int
    request: ReconstructionRequest
    settings: Settings
    rig: Rig

    def event(self, ledger: Ledger, folder: SceneFolder) -> ReconstructionBegun | None:
        """Returns the event that starts the reconstruction, or None if the same request has already started it.

        Args:
            ledger: the scene's current ledger.
            folder: the scene's current folder.

        Raises:
            Problem: 409 if `number` is not the next number, or the scene is archived; 409 if the
                reconstruction cannot start with the requested frame, or committed frames would be
                discarded without consent; 422 if depth cannot be determined.
        """
        if self._is_repeated(ledger):
            return None
        if ledger.edited.archived:
            raise Problem(
                409,
                "the scene is archived",
                field="archived",
                value=True,
                remedy='unarchive it first: PATCH …/scenes/{id} with {"archived": false}, scas4d scenes restore',
            )
        index = self._first_frame(ledger)
        count = len(ledger.committed)
        if count > 1 and not self.request.discard:
            raise Problem(
                409,
                f"a restart would discard the states of {count_noun(count, 'committed frame')}",
                field="discard",
                value=False,
                remedy="set discard to true (begin-again --discard) to discard them, or create another scene",
                committed=count,
            )
        cloud: int | None = None
        if self.request.points:
            cloud = self.number if folder.points_of(self.number).exists() else folder.cloud
        try:
            check_start(self.rig, cloud is not None and folder.points_of(cloud).exists())
        except RigError as error:
            raise rig_problem(error) from None
        return ReconstructionBegun(
            number=self.number,
            index=index,
            points=cloud,
            settings=self.settings.model_dump(mode="json"),
            request=self.request,
        )

    def _is_repeated(self, ledger: Ledger) -> bool:
        """Returns whether the same request has already started the reconstruction.

        Raises:
            Problem: 409 if the request is new and `number` is not the next number.
        """
        now = ledger.reconstruction
        if self.number == now and ledger.begun is not None and ledger.begun.request == self.request:
            return True
        if self.number != now + 1:
            reason = "has already started" if self.number <= now else "is not the next one"
            raise Problem(
                409,
                f"reconstruction {self.number} {reason} (the current one is {now})",
                field="n",
                value=self.number,
                remedy=f"start reconstruction {now + 1}",
                expected=now + 1,
            )
        return False

    def _first_frame(self, ledger: Ledger) -> int:
        """Returns the index of the first frame of the reconstruction.

        Raises:
            Problem: 409 if the reconstruction cannot start with the requested frame.
        """
        frames, index = ledger.frames, self.request.frame
        if index is None:
            sent = (i for i in range(frames.first, len(frames)) if _takes_part(frames[i]))
            index = next(sent, max(frames.first, len(frames)))
        entry = frames.get(index)
        if entry is None or (_takes_part(entry) and entry.files):
            return index
        fault = f"frame {index} is {entry.state}"
        if _takes_part(entry):
            fault = f"the images of frame {index} were deleted"
        held = next((other.index for other in frames.with_pictures() if _takes_part(other)), None)
        remedy = f"start with the next frame to arrive, {ledger.next_frame}"
        if held is not None:
            remedy = f"start with frame {held}, the first with stored images, or with the next frame to arrive, "
            remedy += f"{ledger.next_frame}"
        raise Problem(
            409,
            fault,
            field="frame",
            value=index,
            remedy=f"{remedy}; ingest.keep_frames sets how many frames keep their images",
            expected=ledger.next_frame if held is None else held,
        )


async def journal_new_reconstruction(folder: SceneFolder, beginning: NewReconstruction) -> list[str]:
    """Validates the request again and journals the restart of a stopped scene.

    The second validation is necessary because another frame may have been committed since the first
    validation.

    Returns:
        One message for each fault found in the folder.

    Raises:
        Problem: see `NewReconstruction.event`; 507 if the disk is full.
    """
    definition, _ = await asyncio.to_thread(read_definition, folder)
    recovered = await asyncio.to_thread(recover, folder, definition.id, definition.as_json())
    event = beginning.event(recovered.ledger, recovered.folder)
    assert event is not None
    journal = Journal(folder.journal, recovered.good)
    try:
        await journal.append(*recovered.events, event)
    except OSError as error:
        if no_room(error):
            raise full_disk(error) from None
        raise
    finally:
        await journal.close()
    log.warning("scene %s: starting reconstruction %d with frame %d", folder.name, event.number, event.index)
    return recovered.damage


def _takes_part(entry: FrameEntry) -> bool:
    """Returns whether the frame was acknowledged and can be reconstructed."""
    return entry.receipt is not None and entry.state not in (FrameState.MISSING, FrameState.SKIPPED)
