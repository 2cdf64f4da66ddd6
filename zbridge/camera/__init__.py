"""A robot's camera: its MJPEG stream over HTTP, fetched while somebody watches, published as images and relayed.

``mjpeg`` and ``pace`` are sans-IO; ``upstream`` fetches, ``relay`` serves HQ programs, ``camera`` combines them, and is
imported only if a configuration names a camera. Knows no protocol: a camera is a separate device beside the robot's
links.
"""
