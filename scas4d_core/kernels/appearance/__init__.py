"""Kernels of the appearance effects; of the other files here they use only ``jit``."""
