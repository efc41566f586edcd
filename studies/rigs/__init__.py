"""Rigs of other people, calibrations that are off, cameras that drift."""
