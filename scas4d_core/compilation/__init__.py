"""Compiles kernels in parallel processes before their first use, and tracks which ones are cached."""
