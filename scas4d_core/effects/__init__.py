"""Effects, the named parts of an update, with one file per effect.

``scas4d_core.effect_names`` lists them, ``effect`` defines their interface, and ``switches`` decides which effects are
on. ``scas4d_core.update.parts`` combines the active effects for the update loop, which is independent of any single
effect.
"""
