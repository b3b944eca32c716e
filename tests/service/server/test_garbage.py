"""Garbage of the API process: cycles are still freed, and what stays until the end is not looked at."""

import gc
import weakref

import pytest

from service.server.garbage import YOUNG, collect_seldom


class Knot:
    """An object that refers to itself."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def restored():
    before = gc.get_threshold()
    yield
    gc.unfreeze()
    gc.set_threshold(*before)


def test_cycles_made_later_are_freed(restored):
    stays = Knot()
    collect_seldom()
    assert gc.get_freeze_count() > 0 and not any(each is stays for each in gc.get_objects())
    freed = weakref.ref(Knot())
    kept = [[] for _ in range(2 * YOUNG)]  # enough for a collection of the youngest
    assert freed() is None and len(kept) == 2 * YOUNG
