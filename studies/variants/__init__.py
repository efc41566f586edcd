"""Studies that compare settings on variants of captures: reversed, fewer cameras, fewer pixels.

A setting that was chosen on some captures wins on these; whether it wins is decided by captures that had no say.
"""
