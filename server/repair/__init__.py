"""Finds and repairs damaged files."""
