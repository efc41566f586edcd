"""Decides what may be believed: outlying cameras and frames, exposure, retries, relocation, what is committed."""
