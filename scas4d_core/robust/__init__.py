"""Robustness: rejects faulty cameras and frames, retries and searches, raises alarms.

``solve_frame`` runs the update and decides; ``checks`` looks at the pictures before (black, repeated, exposed
otherwise) and at the state after, ``outliers`` at how well each camera was met, and ``relocation`` finds an object
that jumped. ``timing`` measures which cameras are out of step, and changes nothing.
"""
