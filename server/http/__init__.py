"""HTTP middleware and helpers: authentication, permissions, origin checks, body limits, compression and errors."""
