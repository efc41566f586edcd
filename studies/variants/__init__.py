"""Settings compared on variants of captures: backwards, fewer cameras, fewer pixels.

A setting that was chosen on some captures wins on these; whether it wins is decided by captures that had no say.
"""
