"""The fleet in a browser: who is there and how, and STOP ALL.

One process on the bus serves any number of pages. ``roster`` remembers who was ever there, ``feed`` says what changed,
``fleet_stop`` stops all and judges what came of it, ``server`` speaks to browsers, ``static`` is what they load.
"""
