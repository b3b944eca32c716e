"""The garbage collector of the API process, so that it does not keep every client waiting.

A collection of the oldest generation stops the event loop while it looks at every object of the process: .3 s on one core where some
thousands of connections are open, most of it for modules, routes and tables that stay until the end. CPython's own condition for it
(a quarter more objects than at the last one, https://docs.python.org/3.11/library/gc.html) holds every few seconds while clients come and
go.
"""

import gc

YOUNG, MIDDLE, OLD = 5000, 10, 20
"""Objects allocated, less those freed, until the youngest generation is collected; collections of each generation until one of the next.

Cycles of a request die young. Those that outlive the middle generation are freed after at most YOUNG · MIDDLE · OLD = one million objects
more, some tens of megabytes."""


def collect_seldom() -> None:
    """Leave out of collections what this process has made until now, and look at what is old more seldom. For the end of a start."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG, MIDDLE, OLD)
