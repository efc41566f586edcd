"""Updates of scenes: sends frames to the worker process and records their outcomes."""
