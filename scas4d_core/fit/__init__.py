"""Fits tables of Gaussians to the pictures of one frame: frame 0, what is born later, and what settles after birth."""
