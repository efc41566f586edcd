"""Cost against size: pixels, Gaussians, cameras, the share that moves, frames."""
