"""Made-up scenes whose motion is known: a ball over a floor, and a wall."""
