"""Effects on colour: light, shading, shadows, gloss and camera gains."""
