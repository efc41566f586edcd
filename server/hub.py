"""Hub that publishes the events of each scene to its listeners.

Publishing calls every listener of the scene and never waits for one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

from client.wire import FrameReportModel, FrameState, SceneStatus
from server import counters
from server.problems import Problem
from server.processes.shared_queries import AskReaders, SharedQueries

log = logging.getLogger("scas4d.server")


@dataclass(frozen=True)
class SceneChanged:
    """Event published when a scene's state, progress or queue changes."""


@dataclass(frozen=True)
class FrameFinished:
    """Event published when a frame is committed, or finishes without a state of its own."""

    report: FrameReportModel

    @cached_property
    def text(self) -> str:
        """The report as JSON, serialized once for all listeners."""
        return self.report.model_dump_json()


Event = SceneChanged | FrameFinished


class Listener(Protocol):
    """Interface of a hub listener; all methods must return immediately."""

    def on_event(self, event: Event) -> None:
        """Handles an event of the scene."""

    def on_close(self, reason: str) -> None:
        """Handles the deletion of the scene."""

    def on_restart(self) -> None:
        """Handles the restart of the scene; the listener can rejoin afterwards."""


L = TypeVar("L", bound=Listener)


class Channel:
    """Listeners of one scene and the queries shared between them."""

    def __init__(self, ask: AskReaders) -> None:
        self.listeners: list[Listener] = []
        self.queries = SharedQueries(ask)
        self._status: str | None = None

    def invalidate_status(self) -> None:
        """Discards the cached status after a change."""
        self._status = None

    def status(self, read: Callable[[], SceneStatus]) -> str:
        """Returns the scene's status as JSON, serialized once for all listeners."""
        if self._status is None:
            self._status = read().model_dump_json()
        return self._status


class Hub:
    """Channels of all scenes, keyed by scene id.

    Args:
        max_listeners: maximum number of listeners per scene.
    """

    def __init__(self, max_listeners: int) -> None:
        self.max_listeners = max_listeners
        self._channels: dict[str, Channel] = {}

    def join(self, scene: str, ask: AskReaders, make: Callable[[Channel], L]) -> L:
        """Adds a listener to a scene's channel and returns it.

        Raises:
            Problem: 429 if the scene already has `max_listeners` listeners.
        """
        channel = self._channels.get(scene) or Channel(ask)
        if len(channel.listeners) >= self.max_listeners:
            raise Problem(
                429,
                f"this scene already has the maximum number of subscribers ({len(channel.listeners)})",
                field="SCAS4D_MAX_SUBSCRIBERS",
                value=self.max_listeners,
                remedy="disconnect another subscriber of the scene, or raise the limit",
                headers={"Retry-After": "5"},
            )
        self._channels[scene] = channel
        listener = make(channel)
        channel.listeners.append(listener)
        return listener

    def leave(self, scene: str, listener: Listener) -> None:
        """Removes a listener, and discards its channel if it was the last one."""
        channel = self._channels.get(scene)
        if channel is None or listener not in channel.listeners:
            return
        channel.listeners.remove(listener)
        if not channel.listeners:
            del self._channels[scene]

    def count(self, scene: str | None = None) -> int:
        """Returns the number of listeners of one scene, or of all scenes."""
        channels = self._channels.values() if scene is None else filter(None, [self._channels.get(scene)])
        return sum(len(channel.listeners) for channel in channels)

    def publish(self, scene: str, event: Event) -> None:
        """Notifies every listener of a scene.

        Never blocks and never raises, because listeners must not disturb the scene's own work.
        """
        channel = self._channels.get(scene)
        if channel is None:
            return
        channel.invalidate_status()
        for listener in tuple(channel.listeners):
            try:
                listener.on_event(event)
            except Exception:
                log.exception("scene %s: a subscriber failed to handle event %s", scene, type(event).__name__)

    def close(self, scene: str, reason: str) -> None:
        """Closes the channel of a deleted scene and notifies its listeners."""
        for listener in self._remove_channel(scene):
            listener.on_close(reason)

    def restart(self, scene: str) -> None:
        """Closes the channel of a restarting scene; its listeners are expected to rejoin."""
        for listener in self._remove_channel(scene):
            listener.on_restart()

    def _remove_channel(self, scene: str) -> list[Listener]:
        channel = self._channels.pop(scene, None)
        return [] if channel is None else channel.listeners


class Publisher:
    """Publisher of one scene's events that also updates the frame metrics.

    Args:
        hub: the service's event hub.
        scene: scene id.
    """

    def __init__(self, hub: Hub, scene: str) -> None:
        self._hub = hub
        self._scene = scene

    @property
    def listeners(self) -> int:
        """Number of listeners of the scene."""
        return self._hub.count(self._scene)

    def publish_status(self) -> None:
        """Notifies listeners that the scene's status has changed; call it after every change."""
        self._hub.publish(self._scene, SceneChanged())

    def publish_frame(self, report: FrameReportModel) -> None:
        """Counts and publishes a finished frame; call it once per frame."""
        counters.FRAMES.labels(report.state.value).inc()
        if report.state == FrameState.COMMITTED:
            counters.DROPPED_CAMERAS.inc(len(report.dropped_cameras))
            for alarm in report.alarms:
                counters.ALARMS.labels(alarm.kind.value).inc()
            if report.outcome is not None and report.outcome.degraded:
                counters.DEGRADED.labels("rejected" if report.outcome.rejected else "in_part").inc()
        for stage, seconds in report.seconds.items():
            counters.UPDATE_SECONDS.labels(stage).observe(seconds)
        self._hub.publish(self._scene, FrameFinished(report))
