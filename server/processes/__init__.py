"""Processes of a scene (worker, readers, replayer, exporter), their placement, and queries to the readers."""
