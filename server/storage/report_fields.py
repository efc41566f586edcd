"""Conversion of a frame's commit record to the fields of its API report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client.wire import FrameReportModel

WIRE_NAMES = {"used": "used_cameras", "dropped": "dropped_cameras", "frozen": "frozen_gaussians"}
"""API names of commit record fields that are renamed; all others keep their names. A test checks the mapping."""
NOT_SENT = frozenset({"index", "time", "publish_seconds", "resumed"})
"""Commit record fields that are not sent.

`index` and `time` come from the frame table, and `publish_seconds` is added to ``seconds``.
"""


def committed_fields(record: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the API report fields from a commit record (`scas4d_core.frame_report.FrameReport.record`)."""
    sent = {WIRE_NAMES.get(name, name): value for name, value in record.items() if name not in NOT_SENT}
    fields = {name: sent[name] for name in FrameReportModel.model_fields if sent.get(name) is not None}
    seconds = {name: float(value) for name, value in fields.get("seconds", {}).items()}
    if "report" in seconds:  # the previous report was published only after its own commit
        seconds["report"] += record.get("publish_seconds") or 0.0
    seconds.setdefault("total", sum(seconds.values()))
    return {**fields, "seconds": seconds, "loss": [value for value in fields.get("loss", []) if value is not None]}
