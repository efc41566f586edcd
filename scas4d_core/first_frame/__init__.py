"""Frame 0: initial points, and 3D Gaussian Splatting with adaptive density control."""
