"""Marks of tests beside pytest's own."""

from collections.abc import Iterable

import pytest


def first_short(names: str | tuple[str, ...], values: Iterable[object], **options: object) -> pytest.MarkDecorator:
    """Run a test once for each of these values, as `pytest.mark.parametrize` does, and mark it `long` for all but the first."""
    first, *others = values
    several = not isinstance(names, str)
    return pytest.mark.parametrize(names, [first, *(pytest.param(*(value if several else (value,)), marks=pytest.mark.long)
                                                    for value in others)], **options)
