"""Connections: what one peer may hold open, send slowly or send too much of, before the application is asked."""
