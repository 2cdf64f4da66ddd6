"""The certificates of a secure bus: an authority in a folder, and what it issues (``zbridge certs``).

``x509`` makes and reads keys and certificates, ``authority`` issues, renews, revokes and lists names and reads their
files back, ``bundle`` packs one name for another machine. Knows no bus and no access rule: who may do what is made of
``roles.toml`` elsewhere. Needs the package ``cryptography``, the extra ``zbridge[certs]``; only ``zbridge certs``
imports it.

The folder::

    ca.pem, ca-key.pem      the authority; whoever reads its key can issue any name
    roles.toml              the names, their roles and robots, and the revoked names
    NAME/                   ca.pem, certificate.pem and key.pem of a name
"""
