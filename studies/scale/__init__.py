"""Studies of cost versus size: pixels, Gaussians, cameras, share of moving pixels, frames."""
