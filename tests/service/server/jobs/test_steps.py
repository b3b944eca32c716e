"""Steps read the files of a registered capture beneath its folder, whatever becomes a link while they run."""

import os

import numpy as np
import pytest

from service.errors import RequestError
from service.requests.base.identifiers import CAPTURE
from service.requests.jobs import CheckJob, SolveJob
from service.requests.light.frame_range import numbered
from service.requests.solve import SolveOptions
from service.server.database import intakes
from service.server.jobs.context import Job
from service.server.jobs.steps import _parts
from service.server.storage import layout
from stage.errors import StageError
from stage.formats import exr, images
from tests.scenes.captures import make_scene, write_capture
from tests.service.server.jobs.harness import PROJECT, do_step


@pytest.mark.parametrize(("there", "parts"), [
    (0, [(1, 1), (2, 3), (4, 7), (8, 10)]), (5, [(1, 6), (7, 8), (9, 10)]), (10, [(1, 10)])])
def test_after_a_loss_frames_are_made_in_small_parts_first(tmp_path, there, parts):
    for number in range(1, there + 1):
        (tmp_path / numbered(layout.FRAMES, number)).write_bytes(b"frame")
    assert [(part[0], part[-1]) for part in _parts(list(range(1, 11)), tmp_path)] == parts


@pytest.fixture
def capture(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("registered") / "capture", make_scene(size=8, lights=5))


def solve(harness, capture):
    identifier = harness.register(capture, CAPTURE)
    do(harness, capture, SolveJob(kind="solve", capture=identifier, options=SolveOptions(method="lambert")))


def do(harness, capture, request, **settings):
    job = Job("job_0123456789abcdefghjk", PROJECT, request, 1)
    do_step(job, harness.context(roots=(capture.parent,), max_pixels=64, **settings))


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.long
@pytest.mark.parametrize("name", ["002.exr", "capture.json", "mask.png"])
def test_a_file_that_becomes_a_link_after_it_was_checked_is_not_read(idle_harness, capture, tmp_path, monkeypatch, name):
    from service.solve import solve as product

    outside, whole = tmp_path / "outside", product.solve
    outside.mkdir()
    if name.endswith(".exr"):
        exr.write(outside / name, dict.fromkeys("RGB", np.full((8, 8), 0.5, np.float16)), color_space="lin_rec709_scene", metadata={})
    else:
        (outside / name).write_bytes((capture / name).read_bytes())

    def swapped(request, progress, **others):
        (capture / name).unlink()
        (capture / name).symlink_to(outside / name)
        whole(request, progress, **others)

    monkeypatch.setattr(product, "solve", swapped)
    with pytest.raises(StageError, match=f"{name}: leads out of the folder"):
        solve(idle_harness, capture)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.long
def test_the_worker_decodes_no_image_of_a_capture_and_closes_its_folder(idle_harness, capture, monkeypatch):
    before = len(os.listdir("/proc/self/fd"))
    for name in ("recorded_of", "header_of"):
        monkeypatch.setattr(images, name, lambda source: pytest.fail(f"{source.path} is read here"))
    for _ in range(3):
        solve(idle_harness, capture)
    assert len(os.listdir("/proc/self/fd")) <= before + 5  # connections of the database
    assert (idle_harness.results("job_0123456789abcdefghjk") / "maps.exr").exists()


@pytest.mark.long
def test_a_check_refuses_a_capture_beyond_the_pixels_of_its_project(idle_harness, capture):
    """The capture has five images of 8 × 8."""
    def checked(most):
        identifier = idle_harness.database.transact(lambda connection: intakes.insert(
            connection, project=PROJECT, kind=CAPTURE, name="x", folder=capture))
        do(idle_harness, capture, CheckJob(kind="check", intake=identifier), max_project_pixels=most)
        return intakes.find(idle_harness.database, identifier, PROJECT)["state"]

    assert checked(320) == "ready"
    with pytest.raises(RequestError, match=f"project {PROJECT} has 320 of 639 pixels, and this needs 320"):
        checked(639)
    assert checked(640) == "ready"
