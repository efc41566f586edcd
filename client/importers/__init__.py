"""Importers for captures in the layouts of calibration tools and cameras: rigs, lenses, images and videos."""
