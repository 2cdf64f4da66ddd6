"""The version of zbridge."""

__version__ = "0.1.0"
