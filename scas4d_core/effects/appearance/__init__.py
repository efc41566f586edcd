"""Effects on what the pictures show of a Gaussian: its colour, the light, the cameras' gains."""
