"""Encoder state at the end of a compact file, from which a writer can resume."""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.records import Record


@dataclass(frozen=True, eq=False)
class EncoderState:
    """State that a writer needs to continue a file.

    Attributes:
        head: header of the file.
        records: all records up to the last state.
        record: record of the last state.
        state: last state, as decoded.
        born: all Gaussians so far, as decoded from their birth records.
        clusters: clusters of these Gaussians.
        since_key: number of states since the last key frame.
    """

    head: FileHeader
    records: tuple[Record, ...]
    record: Record
    state: Columns
    born: Columns
    clusters: Clusters
    since_key: int
