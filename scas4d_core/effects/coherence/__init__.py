"""Effects that couple the motion of neighbouring Gaussians."""
