"""A scene's reconstruction begun anew: checks the request, makes the event of it, journals it."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass

from client.wire import FrameState, ReconstructionRequest
from scas4d_core.cameras import Rig
from scas4d_core.rig_checks import RigError, check_start
from scas4d_core.settings import Settings
from server.problems import Problem, counted, of_rig
from server.storage.definition import read_definition
from server.storage.disk import full_disk, no_room
from server.storage.events import ReconstructionBegun
from server.storage.frame_table import FrameEntry
from server.storage.journal import Journal
from server.storage.layout import SceneFolder
from server.storage.ledger import Ledger
from server.storage.recovery import recover

log = logging.getLogger("scas4d.server")


def how_to_begin_again(ledger: Ledger) -> str:
    """Says how a scene that has failed goes on."""
    number = ledger.reconstruction + 1
    return (
        f"begin its reconstruction anew: PUT /v1/scenes/{ledger.scene}/reconstructions/{number}, "
        f"or scas4d begin-again {ledger.scene}"
    )


def begins_anew(id: str) -> Problem:
    """Makes the answer, 503, for a scene whose reconstruction is being begun anew."""
    fault = "the reconstruction of this scene is being begun anew"
    return Problem(503, fault, field="id", value=id, remedy="ask again", headers={"Retry-After": "1"})


@dataclass(frozen=True)
class Beginning:
    """A reconstruction to begin in place of the one before.

    Args:
        number: of it. asked: how. settings: of the scene with those of the request, checked. rig: of the scene.
    """

    number: int
    asked: ReconstructionRequest
    settings: Settings
    rig: Rig

    def event(self, ledger: Ledger, folder: SceneFolder) -> ReconstructionBegun | None:
        """Makes the event of the beginning; None: it was begun before, by the same request.

        Args:
            ledger, folder: of the scene as it is.

        Raises:
            Problem: 409, it is another number's turn, the frame cannot be begun with, or committed frames would be
                dropped unasked; 422, distances are unknown.
        """
        if self._known(ledger):
            return None
        if ledger.edited.archived:
            raise Problem(
                409,
                "the scene is archived: all it has stays as it is",
                field="archived",
                value=True,
                remedy='take that back first: PATCH …/scenes/{id} with {"archived": false}, scas4d scenes restore',
            )
        index = self._first(ledger)
        count = len(ledger.committed)
        if count > 1 and not self.asked.discard:
            raise Problem(
                409,
                f"the states of {counted(count, 'committed frame')} would be dropped",
                field="discard",
                value=False,
                remedy="set discard to true (begin-again --discard) to drop them, or create another scene",
                committed=count,
            )
        cloud: int | None = None
        if self.asked.points:
            cloud = self.number if folder.points_of(self.number).exists() else folder.cloud
        try:
            check_start(self.rig, cloud is not None and folder.points_of(cloud).exists())
        except RigError as error:
            raise of_rig(error) from None
        return ReconstructionBegun(
            number=self.number,
            index=index,
            points=cloud,
            settings=self.settings.model_dump(mode="json"),
            asked=self.asked,
        )

    def _known(self, ledger: Ledger) -> bool:
        """Returns whether the reconstruction was begun before, by the same request."""
        now = ledger.reconstruction
        if self.number == now and ledger.begun is not None and ledger.begun.asked == self.asked:
            return True
        if self.number != now + 1:
            reason = "has begun already" if self.number <= now else "comes after another one"
            raise Problem(
                409,
                f"reconstruction {self.number} {reason}: the scene's is {now}",
                field="n",
                value=self.number,
                remedy=f"begin reconstruction {now + 1}",
                expected=now + 1,
            )
        return False

    def _first(self, ledger: Ledger) -> int:
        """Returns the frame to begin with."""
        frames, index = ledger.frames, self.asked.frame
        if index is None:
            sent = (i for i in range(frames.first, len(frames)) if _is_sent(frames[i]))
            index = next(sent, max(frames.first, len(frames)))
        entry = frames.get(index)
        if entry is None or (_is_sent(entry) and entry.files):
            return index
        fault = f"frame {index} is {entry.state}"
        if _is_sent(entry):
            fault = f"the pictures of frame {index} are deleted"
        held = next((other.index for other in frames.with_pictures() if _is_sent(other)), None)
        remedy = f"begin with the next frame that comes, {ledger.next_frame}"
        if held is not None:
            remedy = f"begin with frame {held}, the first whose pictures are held, or with the next that comes, "
            remedy += f"{ledger.next_frame}"
        raise Problem(
            409,
            fault,
            field="frame",
            value=index,
            remedy=f"{remedy}; ingest.keep_frames of a scene says how many are kept",
            expected=ledger.next_frame if held is None else held,
        )


async def journal_beginning(folder: SceneFolder, beginning: Beginning) -> list[str]:
    """Journals the beginning of a scene that is stopped, if it still may: a frame may have been committed since.

    Returns:
        Sentences about damage that was found.

    Raises:
        Problem: see `Beginning.event`; 507, the disk is full.
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
    log.warning("scene %s begins reconstruction %d with frame %d", folder.name, event.number, event.index)
    return recovered.damage


def _is_sent(entry: FrameEntry) -> bool:
    """Returns whether the frame was acknowledged and takes part in reconstructions."""
    return entry.receipt is not None and entry.state not in (FrameState.MISSING, FrameState.SKIPPED)
