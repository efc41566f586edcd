"""The clusters and the neighbour graph of the moving Gaussians."""
