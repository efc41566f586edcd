"""Cooperation of the services in a cluster, which forward each request to the owner of its scene."""
