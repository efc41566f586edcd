"""The processes of a scene: worker, readers, replayer, exporter; how they are started, and queries to the readers."""
