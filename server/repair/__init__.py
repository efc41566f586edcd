"""Finds damaged files and repairs them."""
