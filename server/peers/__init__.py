"""Cooperation of the services in a cluster, which forward each request to the service that owns its scene."""
