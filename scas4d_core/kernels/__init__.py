"""Fused CPU kernels: flat Numba functions over arrays. Each is tested against plain torch in ``engines.torch``."""
