"""Studies that compare settings on variants of captures: reversed, fewer cameras, fewer pixels.

A setting that was chosen on some captures wins on them. Whether it is better is decided by captures that were not used
for the choice.
"""
