"""HTTP middleware and helpers: authentication, permissions, origin checks, body limits, errors and OpenAPI document."""
