"""The processes of a scene: worker, readers, replayer, and the messages between them and the service."""
