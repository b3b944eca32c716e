"""Timing of a function over several runs."""

import time
from collections.abc import Callable


def run_seconds(work: Callable[[], object], repeats: int = 5) -> list[float]:
    """Return the seconds of each of several runs, after one run that compiles the kernels."""
    work()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return seconds
