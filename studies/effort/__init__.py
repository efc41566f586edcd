"""Budgets kept, and effort spared on frames that show nothing new."""
