"""The processes of a scene: worker, readers, replayer, exporter; their start, and queries to the readers."""
