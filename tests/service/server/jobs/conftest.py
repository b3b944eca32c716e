"""Both databases, and a small capture with what `relit relight` makes of it."""

from pathlib import Path

import numpy as np
import pytest

from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.service.server.jobs.harness import Undisturbed, harness, relit_relight
from tests.service.server.prepared import new_on

FRAMES = 36
SIZE = 256
"""Of the images: large enough that a frame takes some hundredths of a second, so that workers die between frames."""


@pytest.fixture
def on_postgres(server_postgres) -> str:
    return new_on(server_postgres)


@pytest.fixture
def idle_harness(tmp_path: Path, database_url: str | None):
    """A harness that has not started a worker."""
    with harness(tmp_path, database_url) as made:
        yield made


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    folder = tmp_path_factory.mktemp("undisturbed")
    capture = write_capture(folder / "capture", make_scene(size=SIZE, lights=6))
    environment = write_exr(folder / "sky.exr", np.random.default_rng(7).random((16, 32, 3)))
    return Undisturbed(capture, environment, FRAMES, relit_relight(capture, environment, FRAMES, folder / "frames"))
