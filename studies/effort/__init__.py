"""Studies of time budgets, and of iterations saved on frames without changes."""
