"""Effects on how things move: the parameters of the deformation that are free."""
