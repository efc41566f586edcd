"""Scene updates: sends frames to the worker process and records their outcome."""
