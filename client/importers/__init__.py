"""Captures as calibration tools and cameras leave them, made into pinhole cameras and pictures."""
