"""Initial points: what pictures of calibrated cameras say of the surfaces of one moment."""
