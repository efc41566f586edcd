"""Single bit flips in stored files: each must be noticed or harmless, and no image may be wrong.

One scene is sent frame by frame. Before each frame, one bit of one file is flipped, while the service runs or while it
is down. The study then requests views, sends the next frame, and compares everything with an undisturbed run. If the
service cannot repair the bit, the study restores it, so that only one bit is wrong at a time.
"""

from __future__ import annotations

import io
import random
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
from PIL import Image

from scas4d_core.storage.history import NEWEST_KEPT
from scas4d_core.storage.npz import read_npz
from server.storage.frame_store import FrameDamage, read_pictures
from server.storage.layout import DataFolder
from studies.running.process import Service, StudyError
from studies.running.study import AGAIN_S, Study, digests, running
from tests.helpers.journals import read_journal

KINDS = ("state", "checkpoint", "fixed", "journal", "frame")
BEFORE = 6
"""Number of frames committed before the first bit is flipped."""
NOTICED_S = 60.0
"""Seconds within which a flip must be noticed. In this study, the scrub runs almost continuously."""
KEPT = 100
"""Number of frames whose images are kept. Older states cannot be recomputed and are reported as lost."""
CLOSE_DB = 3.0
"""Largest PSNR loss of a recomputed state compared with the lost one, on the images of its frame."""
SCRUB = {"SCAS4D_SCRUB_MB_PER_SECOND": "1000", "SCAS4D_SCRUB_PAUSE_SECONDS": "0.2"}

Pictures = dict[int, bytes]


@dataclass
class Flips:
    """Outcome of the bit flips.

    Attributes:
        counts: number of noticed and of harmless flips, keyed by kind of file.
        recomputed: frames whose state was recomputed.
        lost: frames whose state is lost.
        unreported: frames whose state is unchanged but whose report is lost.
        faults: violated requirements.
    """

    counts: Counter[str] = field(default_factory=Counter)
    recomputed: set[int] = field(default_factory=set)
    lost: set[int] = field(default_factory=set)
    unreported: set[int] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)


def undisturbed(study: Study) -> tuple[dict[int, str], Pictures]:
    """Returns the digests of the states of an undisturbed run, and a view of each frame as PNG."""
    with running(study, "undisturbed_views") as (service, scene, sender):
        for index in range(len(study.frames)):
            sender.send(index)
        service.finish(scene, len(study.frames))
        views = {index: _view(service, study, scene, index).content for index in range(len(study.frames))}
        return digests(DataFolder(service.data).scene(scene).states), views


def flips(study: Study, count: int, seed: int) -> Flips:
    """Flips `count` bits and returns the outcome.

    The kinds of files take turns, and half of the bits are flipped while the service is down.
    """
    random_ = random.Random(seed)
    expected, views = undisturbed(study)
    counts = Flips()
    with running(study, "flips", SCRUB, keep_frames={"last": KEPT}) as (service, scene, sender):
        for index in range(BEFORE):
            sender.send(index)
        service.finish(scene, BEFORE)
        for number in range(count):
            kind, down = KINDS[number % len(KINDS)], number // len(KINDS) % 2 == 0
            one = _Flip(study, service, scene, kind, BEFORE + number, random_)
            said = f"{number + 1} of {count}: {one.said}{', while the service is down' if down else ''}"
            try:
                outcome = one.run(down, counts, views)
                sender.send(BEFORE + number)
                service.finish(scene, BEFORE + number + 1)
                print(f"{said}: {outcome}")
            except StudyError as error:
                one.faults.append(str(error))
            counts.faults += [f"{said}: {fault}" for fault in one.faults]
        counts.faults += sender.check()
        states = digests(DataFolder(service.data).scene(scene).states)
        others = counts.recomputed | counts.lost | counts.unreported
        wrong = [index for index in expected if index not in others and states.get(index) != expected[index]]
        if wrong:
            counts.faults.append(f"states {wrong} are not bit-identical")
        return counts


class _Flip:
    """A flip of one bit in one file, and the checks that it must pass."""

    def __init__(
        self, study: Study, service: Service, scene: str, kind: str, frames: int, random_: random.Random
    ) -> None:
        self.study, self.service, self.scene, self.kind = study, service, scene, kind
        self.folder = DataFolder(service.data).scene(scene)
        self.frames = frames
        self.index, self.file = self._choose(random_)
        self.whole = self.file.read_bytes()
        self.at, self.bit = random_.randrange(len(self.whole)), 1 << random_.randrange(8)
        self.said = f"{kind}, bit {self.bit} of byte {self.at} of {self.file.name}"
        self.faults: list[str] = []

    def _choose(self, random_: random.Random) -> tuple[int, Path]:
        """Returns a random file of the given kind, and the index of the frame to which it belongs."""
        newest, states = self.frames - 1, self.folder.states
        match self.kind:
            case "state":
                index = random_.choice([newest, newest - 1, 0, random_.randrange(1, newest - 1)])
                return index, states / f"frame_{index:06d}.npz"
            case "checkpoint":
                files = sorted(states.glob("checkpoint_*.npz")) or [states / "fixed.npz"]
                return newest, random_.choice(files[-NEWEST_KEPT:])
            case "fixed":
                return newest, states / random_.choice(["fixed.npz", "fixed.copy.npz", "first.copy.npz"])
            case "journal":
                return newest, self.folder.journal
            case _:
                return newest, random_.choice(sorted(self.folder.frames.glob("*.frame")))

    def run(self, down: bool, found: Flips, views: Pictures) -> str:
        """Flips the bit, checks the service's responses, and repairs the file if the service has not.

        Args:
            down: whether the service is down during the flip.
            found: outcome to which the flip is added.
            views: views of the undisturbed run.

        Returns:
            "noticed" or "harmless".
        """
        service = self.service
        if down:
            service.kill()
        before = set() if down else set(service.status(self.scene).damage)
        data = bytearray(self.whole)
        data[self.at] ^= self.bit
        with self.file.open("r+b") as opened:
            opened.seek(self.at)
            opened.write(data[self.at : self.at + 1])
        harmless = self._harmless()
        if down:
            service.start()
        until = time.monotonic() + NOTICED_S
        while not (noticed := bool(set(service.status(self.scene).damage) - before)):
            if harmless or time.monotonic() > until:
                break
            time.sleep(AGAIN_S)
        if not noticed and not harmless:
            self.faults.append("the flip was neither noticed nor harmless")
        while service.status(self.scene).error is not None and time.monotonic() < until:
            time.sleep(AGAIN_S)
        if (error := service.status(self.scene).error) is not None:
            self.faults.append(f"the scene still reports the error: {error}")
        for index in sorted({0, self.index, self.frames // 2, self.frames - 1}):
            self._look(index, found, views)
        self._put_right(bytes(data))
        outcome = "noticed" if noticed else "harmless"
        found.counts[f"{self.kind} {outcome}"] += 1
        return outcome

    def _harmless(self) -> bool:
        """Returns whether everything read from the file equals what was written."""
        try:
            if self.kind == "frame":
                return bool(read_pictures(self.file.parent, self.file.name).images)
            if self.kind == "journal":
                return not read_journal(self.file).damage
            now, then = read_npz(self.file), np.load(io.BytesIO(self.whole), allow_pickle=False)
            return now.keys() == set(then.files) and all(now[name].tobytes() == then[name].tobytes() for name in now)
        except (FrameDamage, ValueError):
            return False

    def _look(self, index: int, found: Flips, views: Pictures) -> None:
        """Checks that a view and its report are unchanged, or that any loss or recomputation is reported."""
        until = time.monotonic() + NOTICED_S
        while (answer := _view(self.service, self.study, self.scene, index)).status_code == 503:
            self._no_path(answer)
            if time.monotonic() > until:
                self.faults.append(f"a view of frame {index} is still unavailable: {answer.text}")
                return
            time.sleep(AGAIN_S)
        self._no_path(answer)
        report = self.service.frame(self.scene, index)
        if answer.status_code == 404 and report.deleted and not report.pictures_kept:
            found.lost.add(index)
        elif answer.status_code != 200:
            self.faults.append(f"a view of frame {index} got status {answer.status_code}: {answer.text}")
        elif report.recomputed:
            found.recomputed.add(index)
            truth = self.study.frames[index][0][self.study.capture.full_rig.names[0]]
            loss = _psnr(views[index], truth) - _psnr(answer.content, truth)
            if loss > CLOSE_DB:
                self.faults.append(f"the recomputed frame {index} is {loss:.1f} dB worse")
        elif report.iterations is None:
            found.unreported.add(index)
        if answer.status_code == 200 and not report.recomputed and answer.content != views[index]:
            self.faults.append(f"the view of frame {index} has changed")

    def _no_path(self, answer: httpx.Response) -> None:
        texts = [answer.text if answer.status_code != 200 else "", self.service.http.get("/v1/scenes").text]
        if any(str(self.service.data) in text for text in texts):
            self.faults.append("a response contains a path on the server")

    def _put_right(self, flipped: bytes) -> None:
        """Repairs the byte if the service could not, so that only one bit is wrong at a time."""
        try:
            with self.file.open("r+b") as opened:
                opened.seek(self.at)
                if opened.read(1) == flipped[self.at : self.at + 1] and self.file.stat().st_size == len(flipped):
                    opened.seek(self.at)
                    opened.write(self.whole[self.at : self.at + 1])
        except FileNotFoundError:  # a checkpoint that was replaced
            return


def _view(service: Service, study: Study, scene: str, index: int) -> httpx.Response:
    return service.http.get(
        f"/v1/scenes/{scene}/render",
        params={"camera": study.capture.full_rig.names[0], "frame": index, "format": "png"},
    )


def _psnr(picture: bytes, truth: bytes) -> float:
    images = [np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float64) for data in (picture, truth)]
    error = float(np.mean((images[0] - images[1]) ** 2))
    return 99.0 if error == 0 else 10 * float(np.log10(255**2 / error))
