"""Effects that model colour: lighting, shading, shadows, gloss and camera gains."""
