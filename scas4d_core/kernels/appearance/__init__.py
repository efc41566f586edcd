"""Kernels of the appearance effects; the only other kernel module that they use is ``jit``."""
