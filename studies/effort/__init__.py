"""Time budgets, and iterations saved on frames that show nothing new."""
