"""``scripts/bench compact``: size and errors of a compact file, compared with the exact states."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from client.cli.scores import Column, markdown
from client.importers.open_source import open_source
from client.rig.sequence import ping_pong
from scas4d_core import metrics
from scas4d_core.cameras import WorldFrame
from scas4d_core.captures import Capture
from scas4d_core.compact import Bounds, CompactReader, CompactWriter, FileHeader
from scas4d_core.compact.encoder import KEY_EVERY
from scas4d_core.engines.limits import DEFAULT, Limits, rig_limits
from scas4d_core.errors import InputError
from scas4d_core.gaussians import UNBORN, Gaussians, moving_extent
from scas4d_core.query.committed import CommittedScene
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

POINTS = 1000
"""Number of tracked points, drawn from the moving Gaussians."""
VIEWS = 6
"""Number of frames in which the test cameras are rendered, spread evenly over the capture."""
READS = 40
"""Number of frames read in random order."""


@dataclass(frozen=True)
class CompactFigures:
    """Measurements of one capture.

    Attributes:
        capture: capture name.
        gaussians: number of Gaussians.
        moving: number of moving Gaussians.
        frames: number of frames in the file.
        exact: size of the exact states on disk, in bytes per frame.
        size: size of the compact file including its header, births and index, in bytes per frame.
        psnr: mean PSNR on the test cameras minus that of the exact states, over ``VIEWS`` frames, in dB. None if there
            are no test cameras.
        worst: lowest PSNR difference of a single frame, in dB.
        tracks: median distance, over points and frames, between decoded and exact tracks, in % of the moving extent.
        write: median CPU time to write a frame, in ms.
        read: median CPU time to read a random frame, in ms.
        read_worst: longest CPU time to read a random frame, in ms.
    """

    capture: str
    gaussians: int
    moving: int
    frames: int
    exact: float
    size: float
    psnr: float | None
    worst: float | None
    tracks: float
    write: float
    read: float
    read_worst: float


def back_and_forth(indices: Sequence[int], count: int) -> list[int]:
    """Returns ``count`` indices by going through the given ones back and forth.

    >>> back_and_forth([0, 1, 2], 7)
    [0, 1, 2, 1, 0, 1, 2]
    """
    return [indices[ping_pong(place, len(indices))] for place in range(count)]


def measure(
    folder: Path, states: Path, frames: int, bounds: Mapping[str, float], key_every: int | None
) -> CompactFigures:
    """Writes a capture's states, played back and forth, to a compact file and compares it with the states.

    Histories in which Gaussians are born are played only once, because births cannot be reversed.

    Args:
        folder: capture folder.
        states: folder that contains the capture's committed states.
        frames: number of frames in the file.
        bounds: error bounds that replace the defaults, keyed by name.
        key_every: frames between keyframes; the default if None.

    Raises:
        InputError: ``frames`` is smaller than the number of states.
    """
    capture = open_source(folder)
    history = History.load(states)
    world = capture.full_rig.world_frame(Settings().scene.metres_per_unit)
    head = FileHeader(world, Bounds(**bounds), background=history.background)
    if frames < len(history):
        raise InputError(f"frames is {frames}", f"use at least {len(history)}: every state is compared")
    grows = history.count > len(history.gaussians(history.indices[0]))
    order = history.indices if grows else back_and_forth(history.indices, frames)  # births cannot be reversed
    exact = float(np.mean([path.stat().st_size for path in states.glob("frame_*.npz")]))
    with TemporaryDirectory() as temporary:
        file = Path(temporary) / "states.s4d"
        written = _write(file, head, (history.gaussians(index) for index in order), key_every or KEY_EVERY)
        with CompactReader(file) as reader:
            reads = _reads(reader)
            first = {index: reader.state(place) for place, index in enumerate(history.indices)}
            psnr, worst = _pictures(capture, world, history, first)
            tracks = _tracks(world, history, first)
        state = history.gaussians(history.indices[0])
        return CompactFigures(
            capture=capture.name,
            gaussians=len(state),
            moving=int(state.moving.sum()),
            frames=len(order),
            exact=exact,
            size=file.stat().st_size / len(order),
            psnr=psnr,
            worst=worst,
            tracks=tracks,
            write=1e3 * float(np.median(written)),
            read=1e3 * float(np.median(reads)),
            read_worst=1e3 * max(reads),
        )


COLUMNS = (
    Column("capture", "capture"),
    Column("Gaussians", "gaussians", ",d"),
    Column("moving", "moving", ",d"),
    Column("frames", "frames", "d"),
    Column("exact, kB/frame", "exact", ".0f"),
    Column("compact, kB/frame", "size", ".1f"),
    Column("test PSNR, dB", "psnr", "+.3f"),
    Column("worst frame", "worst", "+.3f"),
    Column("tracks, % of the extent", "tracks", ".4f"),
    Column("write, ms", "write", ".1f"),
    Column("random read, ms", "read", ".1f"),
    Column("worst", "read_worst", ".1f"),
)


def summarize(found: CompactFigures) -> str:
    """Formats the measurements as a Markdown table."""
    return markdown([asdict(found) | {"exact": found.exact / 1e3, "size": found.size / 1e3}], COLUMNS)


def _write(file: Path, head: FileHeader, states: Iterator[Gaussians], key_every: int) -> list[float]:
    """Writes the states to a file and returns the CPU seconds of each frame after the first."""
    seconds = []
    with CompactWriter(file, head, key_every) as writer:
        for place, state in enumerate(states):
            began = time.process_time()
            writer.add(place, place / 30, state)
            seconds.append(time.process_time() - began)
    return seconds[1:]


def _reads(reader: CompactReader) -> list[float]:
    """Reads the last frame, then ``READS`` frames in random order, and returns the CPU seconds of each random read."""
    draw = np.random.default_rng(0)
    seconds = []
    reader.state(reader.frames[-1])
    for index in draw.choice(reader.frames, min(READS, len(reader.frames)), replace=False).tolist():
        began = time.process_time()
        reader.state(int(index))
        seconds.append(time.process_time() - began)
    return seconds


def _pictures(
    capture: Capture, world: WorldFrame, history: History, decoded: Mapping[int, Gaussians]
) -> tuple[float | None, float | None]:
    rig = capture.test_rig
    if rig is None:
        return None, None
    limits = rig_limits(Settings().scene.near, world, capture.rig.cameras)
    chosen = [history.indices[k] for k in np.linspace(1, len(history.indices) - 1, VIEWS).astype(int)]
    losses = []
    for index in chosen:
        truth = capture.test_frame(index)
        scores = []
        for state in (decoded[index], history.gaussians(index)):
            scene = _scene(world, {index: state}, limits)
            psnrs = [
                metrics.psnr(scene.render(camera, background=history.background).colour, truth.images[camera.name])
                for camera in rig.cameras
            ]
            scores.append(float(np.mean(psnrs)))
        losses.append(scores[0] - scores[1])
    return float(np.mean(losses)), float(min(losses))


def _tracks(world: WorldFrame, history: History, decoded: Mapping[int, Gaussians]) -> float:
    indices, state = history.indices, history.gaussians(history.indices[0])
    rows = np.flatnonzero(state.moving)
    rows = np.random.default_rng(0).choice(rows, min(POINTS, len(rows)), replace=False)
    points = world.to_user(state.means[rows])
    exact = _scene(world, {index: history.gaussians(index) for index in indices})
    decoded_tracks = _scene(world, decoded)
    tracks = [one.tracks_of_points(points, indices[0], indices).positions for one in (exact, decoded_tracks)]
    extent = moving_extent(state) / world.metres_per_unit
    return float(100 * np.nanmedian(np.linalg.norm(tracks[0] - tracks[1], axis=-1)) / extent)


def _scene(world: WorldFrame, states: Mapping[int, Gaussians], limits: Limits = DEFAULT) -> CommittedScene:
    history = History()
    for index, state in states.items():
        known = history.ids if len(history) else state.ids
        born = np.full(len(state) - len(known), UNBORN, np.int64)  # the history assigns their ids
        history.append(index, float(index), state.replace(ids=np.concatenate([known, born])))
    return CommittedScene(history, world, limits)
