"""Fits Gaussians to the images of one frame: those of frame 0 and those added later."""
