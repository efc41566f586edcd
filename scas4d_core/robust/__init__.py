"""Robustness: rejects faulty cameras and frames, retries and searches, and raises alarms.

``solve_frame`` runs the update and decides on its outcome. ``checks`` inspects the images before (dark, repeated,
differently exposed) and the state after. ``outliers`` evaluates the fit of each camera, and ``relocation`` finds an
object that jumped. ``timing`` measures which cameras are out of step, and changes nothing.
"""
