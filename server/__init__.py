"""The service: takes frames over HTTP, runs scenes in worker processes, answers views, tracks and parts."""
