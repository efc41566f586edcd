"""Compiles the kernels before they are needed: which there are, which are in the cache, and who compiles the others."""
