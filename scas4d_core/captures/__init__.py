"""Captures on disk: `open_capture` is the door."""

from scas4d_core.captures.frame import Frame, InitialPoints

__all__ = ["Frame", "InitialPoints"]
