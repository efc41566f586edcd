"""Reconstruction quality: captures by settings and seeds against the ground truth."""
