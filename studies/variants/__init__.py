"""Studies that compare settings on variants of captures: reversed, fewer cameras, fewer pixels.

A setting that was chosen on some captures performs best on these. Only captures that were not used for the choice show
whether it is better.
"""
