"""Robustness: which cameras, pictures and results of a frame are believed, and further attempts at those that fail.

``solve_frame`` runs the update and decides; ``picture_checks`` looks at the pictures before (black, repeated, exposed
otherwise), ``outliers`` at how well each camera was met, ``validation`` at the state, and ``relocation`` finds an
object that jumped.
"""
