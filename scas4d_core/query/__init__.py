"""Reads committed states: views, tracks, parts, exports."""
