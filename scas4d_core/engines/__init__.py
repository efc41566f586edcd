"""Engines: the arithmetic of an update, one engine a device, behind one interface (``engine.UpdateEngine``).

``cpu`` has the kernels that the service runs. ``torch`` is the reference: plain torch with autograd in float64, which
every other engine is tested against. ``plan`` and ``engine`` have the values that cross the interface; ``renderer`` is
the interface for everything else that draws a state: probe views, checks, births, frame 0 and views of clients.
"""
