"""Who of the machine may read the files of the service: its user, and as far as the operator wishes, its group."""

import os

PRIVATE = 0o027
"""Bits that new files and folders do not have: others read neither captures nor the database, and the group writes nothing."""


def keep_private() -> None:
    """Let this process, and those that it starts, make files that others cannot read; a stricter mask stays."""
    os.umask(os.umask(PRIVATE) | PRIVATE)
