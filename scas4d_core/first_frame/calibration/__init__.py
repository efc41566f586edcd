"""Checks the calibration against the images of frame 0, and refines it on request."""
