"""Simulation of a large cluster on a virtual clock: the service's own supervision on modelled nodes and workers."""
