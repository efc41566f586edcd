"""The end of a compact file, for a writer that goes on with it after a stop."""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.records import Record


@dataclass(frozen=True, eq=False)
class EncoderState:
    """The end of a file that is gone on with.

    Attributes:
        head: of the file. records: up to the last state. record: the record of that. state: that, as it is read.
        born, clusters: of all Gaussians so far, as they were coded. since_key: states since the last key.
    """

    head: FileHeader
    records: tuple[Record, ...]
    record: Record
    state: Columns
    born: Columns
    clusters: Clusters
    since_key: int
