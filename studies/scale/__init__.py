"""Cost against size: pixels, Gaussians, cameras, share of moving pixels, frames."""
