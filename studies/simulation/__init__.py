"""A big cluster by a virtual clock: the service's own supervision and fencing, on modelled nodes and workers."""
