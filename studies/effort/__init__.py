"""Studies of time budgets, and of iterations saved on unchanged frames."""
