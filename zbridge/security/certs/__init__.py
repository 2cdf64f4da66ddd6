"""The certificates of a secure bus: an authority in a folder, and what it issues (``zbridge certs``).

``x509`` makes and reads keys and certificates, ``authority`` issues, renews, revokes and lists names and reads their
files back, ``bundle`` packs one name for another machine. Knows no bus and no access rule: permissions are derived
from ``roles.toml`` elsewhere. Needs the package ``cryptography``, the extra ``zbridge[certs]``; only ``zbridge certs``
imports it.

The folder::

    ca.pem, ca-key.pem      the authority; the holder of its key can issue any identity
    roles.toml              the names, their roles and robots, and the revoked names
    NAME/                   ca.pem, certificate.pem and key.pem of a name
"""
