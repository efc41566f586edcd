"""Middleware of all requests: authentication, permissions, origins, body limits, compression, errors."""
