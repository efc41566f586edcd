"""The compact 4D file format: key frames and differences between frames. Requires only NumPy and zstandard."""

from scas4d_core.compact.bounds import Bounds
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.live import LiveEncoder
from scas4d_core.compact.reader import CompactReader, DamagedFileError, FileError
from scas4d_core.compact.records import FormatError, checked_records
from scas4d_core.compact.writer import CompactWriter

__all__ = [
    "Bounds",
    "CompactReader",
    "CompactWriter",
    "DamagedFileError",
    "FileError",
    "FileHeader",
    "FormatError",
    "LiveEncoder",
    "checked_records",
]
