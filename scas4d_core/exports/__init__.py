"""Exports states to the formats of other tools: splats, glTF, USD, tables and TAPVid-MV."""

from scas4d_core.exports.formats import FORMATS, Format, format_of
from scas4d_core.exports.sequence import export_sequence

__all__ = ["FORMATS", "Format", "export_sequence", "format_of"]
