"""Middleware for all requests: authentication, permissions, origin checks, body limits, compression and errors."""
