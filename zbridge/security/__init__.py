"""A secure bus: who its members are, what each may do, their certificates, and the router that enforces it.

``roles`` reads and writes ``roles.toml``, the members and their roles; ``files`` locates files. ``access`` is the table
of what each role may do, also as Zenoh's access rules. ``certs`` issues certificates; ``member``
checks a gateway's certificate before use. ``router`` runs a Zenoh router, configured by ``router_settings``, which also
makes firewall rules for its ports. Knows no protocol and no lease.
"""
