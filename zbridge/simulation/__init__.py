"""What simulated robots share: the room they drive in, and the accounts of fragile ones.

Knows no bus.
"""
