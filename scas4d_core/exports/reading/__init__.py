"""Reads exports back as states if their format identifies each Gaussian."""

from scas4d_core.exports.reading.sources import open_export
from scas4d_core.exports.reading.states import ExportedStates

__all__ = ["ExportedStates", "open_export"]
