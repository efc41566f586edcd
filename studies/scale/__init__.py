"""Studies of cost against size: pixels, Gaussians, cameras, share of moving pixels, and frames."""
