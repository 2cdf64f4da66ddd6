"""The version of zbridge."""

__version__ = "0.2.0"
