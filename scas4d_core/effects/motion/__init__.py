"""Effects that enable the deformation parameters, and the start from the previous motion."""
