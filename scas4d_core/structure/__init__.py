"""Cluster hierarchy and neighbour graph of the moving Gaussians."""
