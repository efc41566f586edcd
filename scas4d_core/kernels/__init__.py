"""Numba kernels of the CPU engine: plain functions on arrays, each tested against PyTorch."""
