"""Fixtures of every test."""

import pytest

from kernels import device as devices


@pytest.fixture(params=devices.names())
def device(request: pytest.FixtureRequest) -> str:
    """Each device of this machine: the CPU always, CUDA where present."""
    return request.param
