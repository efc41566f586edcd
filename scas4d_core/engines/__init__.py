"""Engines that compute updates and fits behind one interface, one engine per device.

``cpu`` holds the kernels that the service runs. ``torch`` is the reference: plain PyTorch with autograd in float64,
against which every other engine is tested. ``plan`` and ``engine`` define the values that cross the interface.
``renderer`` is the interface for all other rendering: probe views, checks, births, frame 0 and client views.
"""
