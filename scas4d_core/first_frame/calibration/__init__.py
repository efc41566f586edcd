"""Compares the calibration with the pictures of frame 0, and refines it on request."""
