"""Mutual TLS without Zenoh: the files of a member, and why a router was not reached.

``certificate`` reads what a certificate says, ``files`` the files of a member and a folder with them, ``refusal``
makes a handshake of its own after Zenoh's failed, ``membership`` asks a router whether it knows us. Python's
``ssl`` is enough: the package ``cryptography`` makes certificates, and nothing else needs it.
"""
