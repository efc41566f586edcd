"""Numba kernels of the CPU engine: plain functions on arrays, tested against PyTorch."""
