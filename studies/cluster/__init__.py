"""Studies of the service on a Ray cluster whose nodes all run on this machine."""
