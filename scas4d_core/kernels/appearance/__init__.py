"""Kernels of the effects on what the pictures show of a Gaussian. Of other files here they use ``jit`` alone."""
