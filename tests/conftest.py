"""Fixtures of every test, and the order of test files."""

import atexit
import gc
from collections.abc import Generator
from pathlib import Path

import pytest

from kernels import device as devices


@pytest.fixture(params=devices.names())
def device(request: pytest.FixtureRequest) -> str:
    """Each device of this machine: the CPU always, CUDA where present."""
    return request.param


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare what is loaded for tests the search for garbage: it stays, and looking through it would take a third of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()
        atexit.register(gc.unfreeze)  # some libraries look for leaks as the interpreter ends; pytest's last search comes before


PROGRAMS = ("clients", "server")
"""Folders of tests that start servers, browsers and other programs."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the files that start other programs evenly over the run: side by side they would wait for each other's processor time.

    Files with more long tests come first, so that at the end no worker of the run is left with one of them.
    """
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    in_order = sorted(files, key=lambda path: -sum(item.get_closest_marker("long") is not None for item in files[path]))
    starts = [path for path in in_order if set(PROGRAMS) & set(path.parts)]
    others = [path for path in in_order if path not in set(starts)]
    place = {path: (number + 0.5) / len(some) for some in (starts, others) for number, path in enumerate(some)}
    items[:] = [item for path in sorted(files, key=lambda path: place[path]) for item in files[path]]
