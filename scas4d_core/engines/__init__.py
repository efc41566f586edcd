"""Engines that run updates and fits on different devices behind a common interface.

``cpu`` and ``warp`` contain the CPU and GPU engines. ``torch`` is the reference implementation in plain PyTorch, with
autograd in float64. All other engines are tested against it. ``plan`` and ``engine`` define the data that the update
loop and an engine exchange. ``renderer`` is the interface for all other rendering, for example in checks, in frame 0
and for client views.
"""
