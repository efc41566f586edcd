"""Processes of scenes on the nodes of a Ray cluster (docs/cluster.md)."""
