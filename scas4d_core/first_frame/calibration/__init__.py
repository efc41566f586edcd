"""Compares the calibration with the images of frame 0, and refines it on request."""
