"""Readers of calibrations, one file per tool; each returns a `Calibration`."""
