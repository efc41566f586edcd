"""Effects on colour: light, shading, shadows, gloss, camera gains."""
