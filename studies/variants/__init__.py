"""Studies that compare settings on variants of captures: reversed, fewer cameras, fewer pixels.

A setting that was tuned on certain captures performs best on those captures. Only captures that were not used for
tuning show whether the setting is better in general.
"""
