"""Fixtures of the USD tests."""

import pytest

from stage.maps import SurfaceMaps
from tests.service.usd.surfaces import make_ball


@pytest.fixture
def ball() -> SurfaceMaps:
    """A hemisphere with every layer."""
    return make_ball()
