"""Updates of a scene: the worker process, the frame it has, and what becomes of each frame."""
