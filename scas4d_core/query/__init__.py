"""Reads what was committed: views, tracks, parts, exports."""
