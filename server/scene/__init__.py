"""The life of a scene: its frames through the worker, status, supervision, retention, budgets."""
