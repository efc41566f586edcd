"""Numba kernels of the CPU engine: flat functions over arrays, each tested against torch."""
