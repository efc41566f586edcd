"""Studies that measure the method; ``scas4d bench`` runs them."""
