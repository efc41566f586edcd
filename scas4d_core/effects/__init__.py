"""Effects: the named parts of an update, one file each.

``scas4d_core.effect_names`` lists them, ``effect`` has their interface, ``switches`` decides which are on, and
``scas4d_core.update.parts`` puts these together for the loop of an update, which knows none by name.
"""
