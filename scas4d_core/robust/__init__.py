"""Robustness: rejects faulty cameras and frames, retries and searches, and raises alarms.

``solve_frame`` runs the update and decides on its outcome. ``checks`` inspects the images before the update
(dark, repeated or differently exposed) and the state after it. ``outliers`` evaluates the fit of each camera, and
``relocation`` finds an object that jumped. ``timing`` measures which cameras are out of step but corrects nothing.
"""
