"""The process that answers from committed states: views, tracks, parts, exports. It never waits for an update."""

from __future__ import annotations

import logging
import os
import signal
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.wire import PartsModel, tracks_model
from scas4d_core.history import History, HistoryError
from server import encode
from server.engine import Reader, load_engine
from server.messages import (
    Answer,
    Ask,
    Committed,
    PartsQuery,
    PlyQuery,
    Query,
    Refused,
    RenderQuery,
    SceneSpec,
    Stop,
    TracksQuery,
)

log = logging.getLogger("scas4d.renderer")


def main(spec: SceneSpec, connection: Connection[Any, Any]) -> None:
    """Runs until told to stop, or until the service is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    renderer = Renderer(spec)
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            break
        if isinstance(message, Stop):
            break
        if isinstance(message, Committed):
            renderer.stale = True
        elif isinstance(message, Ask):
            connection.send(renderer.answer(message))
    logging.shutdown()
    os._exit(0)


class Renderer:
    """Answers queries one after the other."""

    def __init__(self, spec: SceneSpec) -> None:
        self.spec = spec
        self.engine = load_engine(spec.engine)
        self.stale = True
        self._reader: Reader | None = None
        self._times: dict[int, float] = {}
        self._labels: dict[int | None, NDArray[np.int64]] = {}
        self._ids = np.empty(0, dtype=np.int64)

    @property
    def reader(self) -> Reader:
        """The engine's reader of all that is committed."""
        if self._reader is None or self.stale:
            history = History.load(self.spec.states)
            self._times = dict(zip(history.indices, history.times.tolist(), strict=True))
            self._ids = history.gaussians(history.indices[-1]).ids
            self._reader = self.engine.reader(self.spec.rig, self.spec.settings, history)
            self._labels = {}
            self.stale = False
        return self._reader

    def labels(self, count: int | None) -> NDArray[np.int64]:
        """Part labels, found once for what is committed now: a live view asks for them again and again."""
        reader = self.reader
        if count not in self._labels:
            self._labels[count] = reader.parts(count)
        return self._labels[count]

    def answer(self, ask: Ask) -> Answer | Refused:
        """The encoded answer, or why there is none."""
        try:
            return self._answer(ask.number, ask.query)
        except (ValueError, HistoryError) as error:
            log.warning("scene %s refused %s: %s", self.spec.folder.name, type(ask.query).__name__, error)
            return Refused(ask.number, str(error))
        except Exception as error:
            log.exception("scene %s, %s", self.spec.folder.name, type(ask.query).__name__)
            return Refused(ask.number, f"{type(error).__name__}: {error}", fault=True)

    def _answer(self, number: int, query: Query) -> Answer:
        match query:
            case RenderQuery():
                labels = self.labels(query.parts) if "parts" in query.kinds else None
                view = self.reader.render(query.camera, query.frame, background=query.background, labels=labels)
                body, media_type, headers = encode.view(view, query.kinds, query.format)
                return Answer(number, body, media_type, {**headers, "X-Frame": str(query.frame)})
            case TracksQuery():
                return self._tracks(number, query)
            case PartsQuery():
                labels = self.labels(query.count)
                count = query.count or int(labels.max(initial=-1)) + 1
                model = PartsModel(count=count, ids=self._ids.tolist(), labels=labels.tolist())
                return Answer(number, model.model_dump_json().encode(), "application/json")
            case PlyQuery():
                file = self.spec.folder / "splat.ply"
                self.reader.write_ply(file, query.frame)
                return Answer(number, file.read_bytes(), "application/octet-stream")

    def _tracks(self, number: int, query: TracksQuery) -> Answer:
        frames = list(query.frames)
        if query.ids is not None:
            tracks = self.reader.tracks_of_ids(np.array(query.ids, dtype=np.int64), frames)
        elif query.pixels is not None and query.camera is not None:
            tracks = self.reader.tracks_of_pixels(query.camera, query.pixels, query.at, frames)
        else:
            assert query.points is not None
            tracks = self.reader.tracks_of_points(query.points, query.at, frames)
        for camera in query.project:
            if camera.name not in tracks.visibility:
                tracks = self.reader.with_visibility(tracks, camera, query.at)
        pixels = {camera.name: tracks.pixels(camera) for camera in query.project}
        visible = {camera.name: tracks.visibility[camera.name] for camera in query.project}
        times = [self._times[frame] for frame in frames]
        if query.format == "npz":
            arrays = {
                "tracks_XYZ": tracks.positions,
                "ids": tracks.ids,
                "confidence": tracks.confidence,
                "frames": np.array(frames),
                "times": np.array(times),
            }
            arrays |= {f"pixels.{name}": uv for name, uv in pixels.items()}
            arrays |= {f"visibility.{name}": seen for name, seen in visible.items()}
            return Answer(number, encode.npz(arrays), encode.NPZ)
        model = tracks_model(frames, times, tracks.ids, tracks.confidence, tracks.positions, pixels, visible)
        return Answer(number, model.model_dump_json().encode(), "application/json")
