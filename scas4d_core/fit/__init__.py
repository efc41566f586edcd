"""Fits Gaussians to the images of a single frame, both for frame 0 and for Gaussians added later."""
