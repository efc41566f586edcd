"""Kernels for appearance effects, which are independent of all other kernel modules except ``jit``."""
