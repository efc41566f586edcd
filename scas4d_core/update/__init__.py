"""The update of one frame (paper, algorithm 1): from Θ_{t−1} and the pictures of frame t to Θ_t."""
