"""The garbage collector of the processes of the service, so that it does not keep every client waiting, nor the start of a process.

A collection of the oldest generation stops the event loop while it looks at every object of the process: .3 s on one core where some
thousands of connections are open, most of it for modules, routes and tables that stay until the end. CPython's own condition for it
(a quarter more objects than at the last one, https://docs.python.org/3.11/library/gc.html) holds every few seconds while clients come and
go.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

YOUNG, MIDDLE, OLD = 5000, 10, 20
"""Objects allocated, less those freed, until the youngest generation is collected; collections of each generation until one of the next.

Cycles of a request die young. Those that outlive the middle generation are freed after at most YOUNG · MIDDLE · OLD = one million objects
more, some tens of megabytes."""


@contextmanager
def spared() -> Iterator[None]:
    """Look for no garbage while modules are imported, and leave what they hold out of every later search: it stays until the end.

    Without it a sixth of the import of a worker is spent on such searches.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.freeze()


def collect_seldom() -> None:
    """Leave out of collections what this process has made until now, and look at what is old more seldom. For the end of a start."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG, MIDDLE, OLD)
