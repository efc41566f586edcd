"""Fields of a frame's report on the wire, made from the record of its commit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client.wire import FrameReportModel

WIRE_NAMES = {"used": "used_cameras", "dropped": "dropped_cameras", "attempts": "tries", "frozen": "frozen_gaussians"}
"""Fields of a commit's record with another name on the wire; all others have the same (a test checks that)."""
NOT_SENT = frozenset({"index", "time", "publish_seconds", "resumed"})
"""Fields of a commit's record that are not sent: the table has the first two, the third is added to ``seconds``."""


def committed_fields(record: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of the report on the wire from the record of a commit (`scas4d_core.frame_report.FrameReport.record`)."""
    sent = {WIRE_NAMES.get(name, name): value for name, value in record.items() if name not in NOT_SENT}
    fields = {name: sent[name] for name in FrameReportModel.model_fields if sent.get(name) is not None}
    seconds = {name: float(value) for name, value in fields.get("seconds", {}).items()}
    if "report" in seconds:  # the report before this one was published after its commit
        seconds["report"] += record.get("publish_seconds") or 0.0
    seconds.setdefault("total", sum(seconds.values()))
    return {**fields, "seconds": seconds, "loss": [value for value in fields.get("loss", []) if value is not None]}
