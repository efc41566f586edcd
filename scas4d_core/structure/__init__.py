"""The structure of what moves: clusters, neighbours, the motion mask."""
