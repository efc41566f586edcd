"""Effects on what is there: things that enter the scene, and things that leave it."""
