"""Reconstruction quality: captures, settings and seeds against the ground truth."""
