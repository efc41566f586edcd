"""Studies that measure the method; ``scripts/bench`` runs them."""
