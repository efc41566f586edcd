"""Numerical hard cases of single functions, on every backend."""
