"""Reader processes of a scene: one serves views and live states, the other tracks, parts and files.

The processes never wait for an update. ``server.processes.readers`` queues their queries.
"""

from __future__ import annotations

import io
import logging
import os
import secrets
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from client.wire import GaussianModel, GaussiansModel, part_colour, parts_model
from scas4d_core.engines.choose import Device, DeviceError, resolve_device
from scas4d_core.engines.limits import rig_limits
from scas4d_core.errors import InputError, message_of, without_paths
from scas4d_core.storage.frame_files import frame_file
from scas4d_core.storage.history import DamagedFrameError, History, UnreadableFrameError
from server.messages import DamageFound, SceneSpec, Stop
from server.processes import track_answers
from server.processes.compact_answers import compact_head, write_compact
from server.processes.joint_answers import joints_model
from server.processes.live_states import LiveStateEncoder
from server.processes.part_labels import PartLabels, resize_labels
from server.processes.placement import use_one_thread
from server.processes.queries import (
    Answer,
    CompactQuery,
    GaussiansQuery,
    JointsQuery,
    LabelsQuery,
    NumberedQuery,
    PartsQuery,
    PlyQuery,
    Query,
    QueryRefused,
    RenderQuery,
    StatesQuery,
    TracksQuery,
)
from server.storage.layout import EXPORT

if TYPE_CHECKING:
    from scas4d_core.query.committed import CommittedScene
    from scas4d_core.query.view import View

BYTES = "application/octet-stream"
EIGHT_BIT = ("colour", "alpha")
"""Kinds that are rendered in 8 bits per channel for image formats."""
QUALITY = 92
"""Default quality of JPEG and WebP images, 1…100."""
CHANNELS = {"colour": ("red", "green", "blue"), "depth": ("depth",), "alpha": ("alpha",), "parts": ("parts",)}

BULK_NICE = 10
"""Niceness increment of the process for tracks, parts and files, which gives priority to views and updates."""

DAMAGED_AT_ONCE = 8
"""Maximum number of damaged states that one part query can skip."""

log = logging.getLogger("scas4d.renderer")


def run_view_reader(spec: SceneSpec, connection: Connection[Any, Any]) -> None:
    """Entry point of the process for views and live states; runs until asked to stop or the service exits."""
    _serve(spec, connection, view_device(spec))


def run_bulk_reader(spec: SceneSpec, connection: Connection[Any, Any]) -> None:
    """Entry point of the process for all other queries, which runs until it is asked to stop or the service exits."""
    os.nice(BULK_NICE)
    for left in spec.folder.path.glob(f"{EXPORT}.*"):  # files left by a process that was killed during a query
        left.unlink(missing_ok=True)
    _serve(spec, connection, "cpu")  # renders too rarely to justify GPU memory


def view_device(spec: SceneSpec) -> Device:
    """Returns the device that renders the views of a scene."""
    try:
        return resolve_device(spec.settings.device)
    except DeviceError as error:  # the scene was created on a machine with a GPU
        log.warning("scene %s: views are rendered on the CPU: %s", spec.folder.name, error)
        return "cpu"


def _serve(spec: SceneSpec, connection: Connection[Any, Any], device: Device) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    renderer = QueryReader(spec, device)
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            break
        if isinstance(message, Stop):
            break
        if isinstance(message, NumberedQuery):
            answer = renderer.answer(message)
            if faults := renderer.pop_faults():  # before the client can repeat a refused query
                connection.send(DamageFound(faults))
            connection.send(answer)
    logging.shutdown()
    os._exit(0)


class QueryReader:
    """Reader that answers queries about committed states, one at a time.

    Args:
        spec: scene specification.
        device: device that renders.
    """

    def __init__(self, spec: SceneSpec, device: Device = "cpu") -> None:
        self.spec, self.device = spec, device
        self._stale: set[int] | None = set()
        self._history: History | None = None
        self._reader: CommittedScene | None = None
        self._parts = PartLabels(spec.folder.parts)
        self._live = LiveStateEncoder(spec)

    @property
    def history(self) -> History:
        """Committed states, opened on first use and then refreshed for the frames that changed."""
        if self._history is None:
            self._history = History.load(self.spec.folder.states)
        elif self._stale is None or self._stale:
            self._history.refresh(self._stale)
        self._stale = set()
        return self._history

    @property
    def reader(self) -> CommittedScene:
        """Scene that computes views, tracks and parts from the committed states; the core is imported on first use."""
        history = self.history
        if self._reader is None:
            from scas4d_core.query.committed import CommittedScene

            use_one_thread()
            settings, rig = self.spec.settings.scene, self.spec.rig
            world = rig.world_frame(settings.metres_per_unit)
            limits = rig_limits(settings.near, world, rig.cameras)
            self._reader = CommittedScene(history, world, limits, self.device)
        return self._reader

    def labels(self, count: int | None) -> NDArray[np.int64]:
        """Returns the part label of each Gaussian [N], computed from all committed states.

        `count` is the number of parts, or None to choose the number automatically.
        """
        return self._parts.of(self.reader, self.history, count)

    def pop_faults(self) -> dict[str, str]:
        """Returns the files found damaged or missing since the last call, as a mapping from name to reason."""
        return {} if self._history is None else self._history.pop_faults()

    def _note_missing(self, query: Query) -> None:
        """Records the missing files of frames that the service considers committed.

        Only the frames of the query are checked.
        """
        frames = (
            query.frames
            if isinstance(query, TracksQuery | JointsQuery | CompactQuery)
            else (getattr(query, "frame", None),)
        )
        history = self._history
        if history is not None and history.files is not None:
            known = set(history.indices)
            for index in frames:
                if index is not None and index not in known:
                    history.files.faults.setdefault(frame_file(index), f"{frame_file(index)} is missing")

    def answer(self, ask: NumberedQuery) -> Answer | QueryRefused:
        """Returns the encoded answer to a query, or a refusal with the reason."""
        asked = f"{ask.query.kind} query"
        self._stale = None if ask.stale is None or self._stale is None else self._stale | ask.stale
        for more in range(DAMAGED_AT_ONCE, -1, -1):
            try:
                return self._answer(ask.number, ask.query)
            except DamagedFrameError as error:
                log.warning("scene %s: %s failed: %s", self.spec.folder.name, asked, error)
                if more and isinstance(
                    ask.query, PartsQuery | LabelsQuery | JointsQuery
                ):  # computed from the remaining states
                    continue
                return QueryRefused(
                    ask.number,
                    message_of(error),
                    "try again later; the service repairs the file if possible",
                    status=503,
                )
            except UnreadableFrameError as error:  # deleted after the service checked
                log.warning("scene %s: %s failed: %s", self.spec.folder.name, asked, error)
                self._note_missing(ask.query)
                return QueryRefused(ask.number, message_of(error), status=404)
            except InputError as error:
                log.warning("scene %s: %s refused: %s", self.spec.folder.name, asked, error)
                status = 404 if isinstance(ask.query, GaussiansQuery) else 422
                return QueryRefused(ask.number, without_paths(error.fault), without_paths(error.remedy), status)
            except ValueError as error:
                log.warning("scene %s: %s refused: %s", self.spec.folder.name, asked, error)
                return QueryRefused(ask.number, message_of(error))
            except Exception as error:
                log.exception("scene %s: %s failed", self.spec.folder.name, asked)
                return QueryRefused(ask.number, f"{type(error).__name__}: {message_of(error)}", status=500)
        raise AssertionError("the last iteration always returns")

    def _answer(self, number: int, query: Query) -> Answer:
        match query:
            case RenderQuery():
                if query.format not in ("npz", "float32") and query.kinds[0] in EIGHT_BIT:
                    pixels = self.reader.render_levels(
                        query.camera, query.frame, query.background, opacity=query.kinds[0] == "alpha"
                    )
                    body, media_type = encode_pixels(pixels, query.format, query.quality)
                    return Answer(number, body, media_type, {"X-Frame": str(query.frame)})
                painted = query.labels
                if painted is not None:
                    painted = resize_labels(painted, len(self.history.gaussians(query.frame)))
                view = self.reader.render(query.camera, query.frame, background=query.background, labels=painted)
                body, media_type, headers = encode_view(view, query.kinds, query.format, query.quality)
                return Answer(number, body, media_type, {**headers, "X-Frame": str(query.frame)})
            case TracksQuery():
                tracks = track_answers.compute_tracks(self.reader, self.history, query)
                return Answer(number, *track_answers.encode(tracks, query, track_answers.metres_per_unit(self.spec)))
            case PartsQuery():
                labels, last = self.labels(query.count), self.history.indices[-1]
                model = parts_model(labels, self.history.gaussians(last).ids, last)
                return Answer(number, model.model_dump_json().encode(), "application/json")
            case JointsQuery():
                joints = self.reader.joints(self.labels(query.count), query.frames)
                found = joints_model(query.frames, [self.history.time(frame) for frame in query.frames], joints)
                return Answer(number, found.model_dump_json().encode(), "application/json")
            case LabelsQuery():
                labels = self.labels(query.count)
                body = labels.astype("<i2").tobytes()
                headers = {"X-Parts-Frame": str(self.history.indices[-1])}
                return Answer(number, body, "application/octet-stream", headers)
            case GaussiansQuery():
                lives = [GaussianModel.model_validate(asdict(life)) for life in self.history.lives(query.ids)]
                listing = GaussiansModel(frame=self.history.indices[-1], gaussians=lives)
                return Answer(number, listing.model_dump_json().encode(), "application/json")
            case StatesQuery():
                body, headers = self._live.records(self.history, query)
                return Answer(number, body, BYTES, headers)
            case PlyQuery():
                return self._file(number, lambda file: self.reader.write_ply(file, query.frame))
            case CompactQuery():
                parts = self.labels(None) if query.parts and self.history.newest.moving.any() else None
                head = compact_head(self.spec, self.history)
                return self._file(
                    number,
                    lambda file: {"X-Last-Frame": str(write_compact(file, self.history, query.frames, head, parts))},
                )

    def _file(self, number: int, write: Callable[[Path], dict[str, str] | None]) -> Answer:
        """Returns an answer with the contents of a temporary file.

        `write` writes the file and may return headers of the answer.
        """
        file = self.spec.folder.export(secrets.token_hex(4))
        try:
            headers = write(file) or {}
            return Answer(number, file.read_bytes(), BYTES, headers)
        finally:
            file.unlink(missing_ok=True)


def float32(arrays: Mapping[str, NDArray[Any]]) -> tuple[bytes, dict[str, str]]:
    """Concatenates arrays along the channel axis and returns them as raw bytes, with headers.

    The bytes are little-endian float32 values. Rows are stored from top to bottom, and channels
    vary fastest. The header X-Shape is "H,W,C", X-Channels lists the names of the C channels, and
    X-Dtype is "<f4".

    Args:
        arrays: [H, W] or [H, W, 3] arrays, keyed by kind.
    """
    names = [channel for kind in arrays for channel in CHANNELS[kind]]
    stack = np.concatenate([array[..., None] if array.ndim == 2 else array for array in arrays.values()], axis=-1)
    body = np.ascontiguousarray(stack, "<f4")
    headers = {"X-Shape": ",".join(map(str, body.shape)), "X-Channels": ",".join(names), "X-Dtype": "<f4"}
    return body.tobytes(), headers


def encode_view(
    view: View, kinds: Sequence[str], format: str, quality: int | None = None
) -> tuple[bytes, str, dict[str, str]]:
    """Encodes a view and returns the body, media type and headers.

    The image formats encode only the first of `kinds`, which is depth or parts; see `EIGHT_BIT` for the others. The
    route has already checked that there is exactly one.

    Args:
        view: rendered view.
        kinds: names of the view's arrays to encode.
        format: format of the body: png, jpeg, webp, npz or float32.
        quality: quality of JPEG and WebP, 1…100; None selects the default.
    """
    arrays: dict[str, Any] = {kind: getattr(view, kind) for kind in kinds}
    if format == "npz":
        return track_answers.npz(arrays), track_answers.NPZ, {}
    if format == "float32":
        body, headers = float32(arrays)
        return body, BYTES, headers
    pixels, headers = _pixels(kinds[0], arrays[kinds[0]])
    if kinds[0] == "parts":  # imageio cannot write palettes
        picture, file = Image.fromarray(pixels), io.BytesIO()
        picture.putpalette(_PART_COLOURS)
        picture.save(file, "PNG", compress_level=1)
        return file.getvalue(), f"image/{format}", headers
    return *encode_pixels(pixels, format, quality), headers


def encode_pixels(pixels: NDArray[np.uint8 | np.uint16], format: str, quality: int | None = None) -> tuple[bytes, str]:
    """Encodes an image [H, W] or [H, W, 3] as ``png``, ``jpeg`` or ``webp``; returns the body and the media type."""
    options: dict[str, Any] = {"compress_level": 1}
    if format == "jpeg":
        options = {"quality": quality or QUALITY, "subsampling": 0}
    elif format == "webp":
        # Live views need speed more than small files; method 0 takes a third of the default's time.
        options = {"quality": quality or QUALITY, "method": 0}
    return imageio.imwrite("<bytes>", pixels, extension=f".{format}", plugin="pillow", **options), f"image/{format}"


def part_colours() -> list[int]:
    """Returns a palette of 256 RGB colours as a flat list of 768 values.

    The palette starts with black, followed by the colour of each part label.
    """
    return [0, 0, 0, *(channel for label in range(255) for channel in part_colour(label))]


_PART_COLOURS = part_colours()


def _pixels(kind: str, array: NDArray[Any]) -> tuple[NDArray[np.uint8 | np.uint16], dict[str, str]]:
    """Returns the pixels and headers of an image: depth in 16 bits, or parts as palette indices."""
    if kind == "parts":
        return array, {}
    met = np.isfinite(array)
    near, far = (float(array[met].min()), float(array[met].max())) if met.any() else (0.0, 0.0)
    steps = 1 + np.rint(65534 * (np.where(met, array, near) - near) / max(far - near, 1e-12))
    return np.where(met, steps, 0).astype(np.uint16), {"X-Depth-Near": repr(near), "X-Depth-Far": repr(far)}
