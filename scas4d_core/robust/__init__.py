"""Robustness: which cameras, pictures and results of a frame are believed, and further attempts at those that fail.

``solve_frame`` runs the update and decides; ``checks`` looks at the pictures before (black, repeated, exposed
otherwise) and at the state after, ``outliers`` at how well each camera was met, and ``relocation`` finds an object
that jumped. ``timing`` tells which cameras are out of step, and changes nothing.
"""
