"""Engines: the arithmetic of updates and fits behind one interface, one engine per device.

``cpu`` has the kernels that the service runs. ``torch`` is the reference: plain torch with autograd in float64, which
every other engine is tested against. ``plan`` and ``engine`` have the values that cross the interface; ``renderer`` is
the interface for everything else that draws a state: probe views, checks, births, frame 0 and views of clients.
"""
