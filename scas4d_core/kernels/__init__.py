"""Fused CPU kernels: flat Numba functions over arrays. Each has a plain-torch twin that tests compare it with."""
