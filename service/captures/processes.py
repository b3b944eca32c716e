"""An environment without secrets, and limits, for the processes that read untrusted files."""

import os
import resource
import sys

from stage.colour.location import VARIABLE, location

KEPT = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TMPDIR", "LD_LIBRARY_PATH", VARIABLE)
"""Variables of the environment that such a process inherits."""


def bare_environment() -> dict[str, str]:
    """Return an environment without the settings of the service, in which Python finds the same modules."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    if VARIABLE in kept:
        kept[VARIABLE] = location()
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    return kept | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}


def limit(**most: int) -> None:
    """Set limits of this process, by the names of `resource` without RLIMIT_: bytes or seconds. It writes no core file."""
    for name, wanted in (most | {"CORE": 0}).items():
        kind = getattr(resource, f"RLIMIT_{name}")
        _, hard = resource.getrlimit(kind)
        allowed = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (allowed, allowed))
