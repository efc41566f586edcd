"""Engines that run updates and fits on different devices behind a common interface.

The service uses the engine in ``cpu``. ``torch`` is the reference implementation in plain PyTorch, with autograd in
float64, against which all other engines are tested. ``plan`` and ``engine`` define the data that the update loop and an
engine exchange. ``renderer`` is the interface for all other rendering, such as checks, frame 0 and client views.
"""
