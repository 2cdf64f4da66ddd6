"""What people look at robots with: pictures of fleet messages, recordings, and servers for viewers.

Knows no protocol and no part of a gateway: a view reads the bus as any program, and drives through the lease of
:mod:`zbridge.client`. What only a view needs is an extra of the package, imported by the view that needs it.
"""
