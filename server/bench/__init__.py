"""Studies of the service that need one running: faults, the speed of ingest."""
