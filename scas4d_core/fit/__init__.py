"""Fits Gaussians to the pictures of one frame: frame 0, and those that are added later."""
