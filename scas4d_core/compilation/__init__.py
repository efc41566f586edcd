"""Compiles the kernels before they are needed, in several processes, and knows which are cached."""
