"""Frame 0: initial points, then 3D Gaussian Splatting with density control."""
