"""Prometheus counters and histograms of this process, updated by the code that they instrument.

This module imports no other module of the service, so that every part of the service can import it. The gauges are in
`server.health.metrics`.
"""

from __future__ import annotations

from functools import partial

from prometheus_client import CollectorRegistry, Counter, Histogram

from scas4d_core.frame_outcome import AlarmKind

SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8, 16, 32, 64, 128, 256)

registry = CollectorRegistry()
"""Registry of this process's metrics, without the metrics of the Python interpreter."""
_counter = partial(Counter, registry=registry)
_histogram = partial(Histogram, registry=registry, buckets=SECONDS)

FRAMES = _counter(
    "scas4d_frames",
    "Frames that reached each state: acknowledged, committed, failed, skipped, missing.",
    ["state"],
)
INGEST_BYTES = _counter("scas4d_ingest_bytes", "Bytes of encoded images and masks in acknowledged frames.")
DEGRADED = _counter(
    "scas4d_degraded_frames",
    "Committed frames that were rejected (keeping the previous state) or only partly fitted.",
    ["how"],
)
DROPPED_CAMERAS = _counter(
    "scas4d_cameras_left_out",
    "Cameras dropped from committed frames because of a missing, undecodable or outlying image.",
)
ALARMS = _counter(
    "scas4d_alarms",
    "Alarms raised in committed frames, by kind.",
    ["kind"],
)
for what in AlarmKind:
    ALARMS.labels(what.value)
UPDATE_SECONDS = _histogram("scas4d_update_seconds", "Duration of each stage of an update.", ["stage"])
FRAME_LATENCY = _histogram(
    "scas4d_frame_latency_seconds",
    "Latency by stage: queue, update, commit, and their total; publish is from commit to sending to the first viewer.",
    ["stage"],
)
QUERY_SECONDS = _histogram(
    "scas4d_query_seconds",
    "Time until a scene's reader answers a query, by outcome and kind: render, tracks, parts, labels, gaussians, ply, "
    "compact.",
    ["kind", "outcome"],
)
STREAM_MISSED = _counter(
    "scas4d_stream_missed",
    "Messages that slow subscribers missed because newer messages replaced them.",
)
RESTARTS = _counter(
    "scas4d_process_restarts",
    "Scene processes that exited unexpectedly and were restarted.",
    ["process"],
)
DAMAGE = _counter(
    "scas4d_damage",
    "Damaged files found while the service was running: state, checkpoint, fixed, journal, frame, definition, points.",
    ["kind"],
)
SCRUBBED = _counter("scas4d_scrubbed_bytes", "Bytes reread in the background and verified against checksums.")
for kind in ("state", "checkpoint", "fixed", "journal", "frame", "definition", "points"):
    DAMAGE.labels(kind)
CONNECTIONS_REFUSED = _counter(
    "scas4d_connections_refused",
    "Connections and requests that were refused before they reached the application, by reason.",
    ["reason"],
)
for state in ("acknowledged", "committed", "failed", "skipped", "missing"):
    FRAMES.labels(state)
for how in ("rejected", "in_part"):
    DEGRADED.labels(how)
for process in ("worker", "reader"):
    RESTARTS.labels(process)
