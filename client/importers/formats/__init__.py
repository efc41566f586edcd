"""Calibration readers, one module per tool. Each returns a `Calibration`."""
