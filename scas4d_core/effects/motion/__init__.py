"""Effects that free the parameters of the deformation, and its start from the previous motion."""
