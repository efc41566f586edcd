"""Robustness: rejection of faulty cameras and frames, retries, searches for objects that jumped, and alarms.

``solve_frame`` runs the update and decides on its outcome. ``checks`` detects dark, repeated or differently exposed
images before the update, and inspects the state after it. ``outliers`` evaluates the fit of each camera, and
``relocation`` finds an object that jumped. ``timing`` measures which cameras are out of step, but corrects nothing.
"""
