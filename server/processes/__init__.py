"""Processes of a scene (worker, readers, replayer, exporter), their placement, and the queries to readers."""
