"""Numerical edge cases of individual functions, on every backend."""
