"""Effects that enable deformation parameters, and the warm start from the previous motion."""
