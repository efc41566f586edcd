"""Variants of captures that cost nothing to make, and contenders for the default that are tried on them.

A setting that was chosen on some captures wins on these; whether it wins is told by captures that had no say.
"""
