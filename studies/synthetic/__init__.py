"""Synthetic scenes with known motion: a ball over a floor, and a wall."""
