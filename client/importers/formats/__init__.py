"""Readers of calibrations, one file a tool; each returns a `Calibration`."""
