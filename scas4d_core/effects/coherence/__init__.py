"""Effects that couple the motion of neighbouring Gaussians, or limit their axis lengths to those of frame 0."""
