"""Which programs are there. One that is not installed skips its tests; with RELIT_TEST_CLIENTS=required, as in CI, they fail them."""

import os

import pytest

from benchmarks.clients import installed
from benchmarks.clients.render import Client


def require(client: Client) -> Client:
    """Return the client, or skip the test where it is missing."""
    try:
        if client is Client.BLENDER:
            installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
        elif client is Client.MITSUBA:
            installed.python_with("mitsuba", "RELIT_TEST_MITSUBA_PYTHON")
        else:
            installed.node_modules(), installed.browser()
    except installed.MissingClientError as error:
        if os.environ.get("RELIT_TEST_CLIENTS") == "required":
            raise
        pytest.skip(str(error))
    return client
