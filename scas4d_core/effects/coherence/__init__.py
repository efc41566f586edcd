"""Effects that tie the motion of neighbouring Gaussians together."""
