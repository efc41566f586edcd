"""Costs of the kernels, and the CPU against the GPU."""
