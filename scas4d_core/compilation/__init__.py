"""Compiles kernels ahead of their first use in several processes, and tracks which ones are cached."""
