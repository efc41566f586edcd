"""Studies of cost against size: pixels, Gaussians, cameras and share of moving pixels."""
