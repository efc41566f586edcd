"""Calibration readers, one module per tool; each returns a `Calibration`."""
