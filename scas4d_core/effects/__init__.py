"""Effects: the parts that an update is made of, one file each (docs/effects.md).

``registry`` names them, ``effect`` has their interface, ``parts`` puts those that are on together for the loop of an
update, ``switches`` decides which are on. The loop knows none of them by name.
"""
