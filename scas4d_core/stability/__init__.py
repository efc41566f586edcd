"""Hard cases, and what must hold in each; ``scas4d bench stability`` runs them."""
