"""Encoding of the joints between parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from client.wire import JointModel, JointsModel

if TYPE_CHECKING:
    from scas4d_core.query.joints import Joint


def joints_model(frames: Sequence[int], times: Sequence[float], joints: Sequence[Joint]) -> JointsModel:
    """Converts joints in T frames to the wire model; NaN becomes null."""
    return JointsModel(
        frames=list(frames),
        times=list(times),
        joints=[
            JointModel(
                parent=joint.parent,
                child=joint.child,
                kind=joint.kind,
                axes=_nullable(joint.axes),
                centres=_nullable(joint.centres),
                values=_nullable(joint.values),
                error=joint.error,
            )
            for joint in joints
        ],
    )


def _nullable(rows: NDArray[np.float64]) -> list[Any]:
    """Returns the rows [T, …] of an array as lists, with None for rows that contain NaN."""
    return [row.tolist() if np.isfinite(row).all() else None for row in rows]
