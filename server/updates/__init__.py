"""The updates of a scene: gives frames to the worker process and records their outcome."""
