"""Hard cases, and what must hold in each; ``scripts/bench stability`` runs them."""
