"""zbridge: legacy robots and operator programs on one Zenoh bus, one gateway process per device.

This package is the core. It knows no robot: each protocol is a package of its own, found through the
entry-point group ``zbridge.protocols``.
"""

__version__ = "0.1.0"
