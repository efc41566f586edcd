"""Siblings: the other services of a cluster. Requests for a scene go on to the one that has it (docs/cluster.md)."""
