"""A stack whose images are decoded one by one as they come: the same bytes as one that is made when all are there."""

from types import SimpleNamespace

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import StorageError
from stage.stack.early import EarlyStack
from stage.stack.ingest import CACHE_FOLDER, Ingest, open_stack
from stage.stack.stack import index_path, saturated_path, values_path
from stage.stack.stack_file import StackFile
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr

LIGHTS = 11
SATURATION = 0.5 * float(make_scene(size=9, lights=LIGHTS).images.max())


@pytest.fixture
def folder(tmp_path):
    """A capture with readings that saturate under some lights."""
    return write_capture(tmp_path / "capture", make_scene(size=9, lights=LIGHTS), saturation=SATURATION)


def taken_early(folder, lights) -> EarlyStack:
    early, capture = EarlyStack(folder / CACHE_FOLDER, LIGHTS), Capture.open(folder)
    for light in lights:
        early.add(capture, capture.sources()[light], light)
    return early


def files_of(stack) -> list[bytes]:
    return [path(stack.folder, stack.key).read_bytes() for path in (index_path, values_path, saturated_path)]


@pytest.mark.parametrize("lights", [range(LIGHTS), (3, 7, 10, 0), ()])
def test_it_is_that_of_all_images_together(tmp_path, folder, lights):
    """The others are decoded in the end."""
    early, seen = taken_early(folder, lights), []
    found = Ingest.of(Capture.open(folder)).stack(lambda done, _: seen.append(done), early)
    assert seen == list(range(len(lights) + 1, LIGHTS + 1))
    other = open_stack(Capture.open(folder), cache=tmp_path / "cache")
    assert found.key == other.key and files_of(found) == files_of(other)
    early.close()
    assert not [name for name in files_in(folder) if "early" in name]


def test_images_and_manifests_that_have_changed_since_are_decoded_anew(tmp_path, folder):
    scene, early = make_scene(size=9, lights=LIGHTS), taken_early(folder, range(LIGHTS))
    write_exr(folder / "004.exr", 0.5 * scene.images[4])  # taken again: less of it saturates
    seen = []
    found = Ingest.of(Capture.open(folder)).stack(lambda done, _: seen.append(done), early)
    assert seen == [LIGHTS]
    assert files_of(found) == files_of(open_stack(Capture.open(folder), cache=tmp_path / "cache"))
    early = taken_early(folder, range(LIGHTS))
    write_exr(folder / "dark.exr", np.full((9, 9, 3), 0.01))
    write_capture(folder, scene, saturation=SATURATION, dark="dark.exr")
    seen.clear()
    found = Ingest.of(Capture.open(folder)).stack(lambda done, _: seen.append(done), early)
    assert seen == list(range(1, LIGHTS + 1))  # all of them
    assert files_of(found) == files_of(open_stack(Capture.open(folder), cache=tmp_path / "cache"))


def test_a_file_that_is_replaced_while_an_image_is_decoded_makes_its_plane_stale(tmp_path, folder, monkeypatch):
    """As a dark picture is that is taken again meanwhile: the plane was made with the one before."""
    write_exr(folder / "dark.exr", np.full((9, 9, 3), 0.01))
    write_capture(folder, make_scene(size=9, lights=LIGHTS), saturation=SATURATION, dark="dark.exr")
    early = taken_early(folder, range(LIGHTS - 1))
    write = StackFile.write

    def slow(file, light, radiance):
        write_exr(folder / "dark.exr", np.full((9, 9, 3), 0.02))
        write(file, light, radiance)
    monkeypatch.setattr(StackFile, "write", slow)
    capture = Capture.open(folder)
    early.add(capture, capture.sources()[-1], LIGHTS - 1)
    monkeypatch.undo()
    found = Ingest.of(Capture.open(folder)).stack(early=early)
    assert files_of(found) == files_of(open_stack(Capture.open(folder), cache=tmp_path / "cache"))


def test_without_space_it_is_refused_and_leaves_nothing(folder, monkeypatch):
    """The images that are still to come need their space too."""
    needed = StackFile.size(LIGHTS, 81) + LIGHTS * (folder / "000.exr").stat().st_size
    monkeypatch.setattr("shutil.disk_usage", lambda place: SimpleNamespace(free=needed - 1))
    with pytest.raises(StorageError, match="no space for the stack beside the images"):
        taken_early(folder, [0])
    assert not [name for name in files_in(folder) if name.endswith(".npy")]


def test_what_is_given_up_leaves_nothing(folder):
    early = taken_early(folder, (1, 2))
    early.close()
    assert not [name for name in files_in(folder) if name.endswith(".npy")]


def test_another_number_of_images_makes_it_of_no_use(folder):
    early, seen = EarlyStack(folder / CACHE_FOLDER, LIGHTS + 1), []
    capture = Capture.open(folder)
    early.add(capture, capture.sources()[0], 0)
    Ingest.of(capture).stack(lambda done, _: seen.append(done), early)
    early.close()
    assert len(seen) == LIGHTS and not [name for name in files_in(folder) if "early" in name]
