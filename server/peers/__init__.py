"""Several services of one cluster: passes a request on to the service that has the scene."""
