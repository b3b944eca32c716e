"""Inputs are opened beneath their folder and in bounds, and texts in them are limited."""

import importlib
import json
import os
import pkgutil
import threading
import typing
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

import service.requests
import stage
from service.requests.base.base import Options, Role
from service.requests.jobs import UserJob
from stage import inputs
from stage.capture.capture import Capture
from stage.capture.manifest import read_manifest
from stage.errors import ImageError, ManifestError, StageError, StorageError
from stage.formats import exr, images
from stage.importers import lp
from stage.importers.opencv_file import read_matrices
from stage.model import Line, Strict, name_fault
from stage.stack.ingest import open_stack
from stage.tof.raw_frames import read_array
from tests.scenes.captures import make_scene, write_capture, write_image
from tests.service.server.api.captures import lying_exr, lying_png, manifest

SIDE = 16
NOISE = np.random.default_rng(0).integers(0, 40, (SIDE, SIDE, 3), dtype=np.uint8)  # a JPEG XL of less than 128 bytes is not read
WRITERS = {
    "a.exr": lambda path, value: exr.write(path, dict.fromkeys("RGB", np.full((SIDE, SIDE), value / 255, np.float16)),
                                           color_space="lin_rec709_scene", metadata={}),
    **{f"a.{suffix}": lambda path, value: write_image(path, NOISE + np.uint8(value)) 
       for suffix in ("png", "tif", "jpg", "dpx", "jxl", "tga", "bmp")},
    "a.hdr": lambda path, value: write_image(path, np.full((SIDE, SIDE, 3), value / 255, np.float32)),
}
BAD = {"NUL": "a\0b", "newline": "a\nb", "escape": "\x1b[2J", "delete": "a\x7f", "C1": "a\x9b", "half": "b\ud800",
       "byte": "b\udcff", "long": "x" * 1001}


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """A root with a folder in it, and a folder outside."""
    inside, outside = tmp_path / "root" / "project" / "capture", tmp_path / "outside"
    inside.mkdir(parents=True)
    outside.mkdir()
    return inside, outside


@pytest.mark.parametrize("name", WRITERS)
def test_an_image_that_became_a_link_to_elsewhere_is_not_read(folders, name):
    inside, outside = folders
    WRITERS[name](inside / name, 100)
    WRITERS[name](outside / name, 200)
    with inputs.confined(inside, inside.parents[1]):
        own = images.read_pixels(inside / name)
        (inside / name).unlink()
        (inside / name).symlink_to(outside / name)
        for read in (images.read_header, images.read_pixels, images.read_recorded):
            with pytest.raises(ManifestError, match=f"{name}: leads out of the folder"):
                read(inside / name)
    assert abs(float(own.mean()) - float(images.read_pixels(inside / name).mean())) > 0.1  # which is that of outside


@pytest.mark.parametrize("name", WRITERS)
def test_checks_and_decoders_read_the_file_that_was_opened(folders, name):
    """A path that leads to another file after it was opened changes nothing."""
    inside, outside = folders
    WRITERS[name](inside / name, 100)
    WRITERS[name](outside / name, 200)
    own = images.read_pixels(inside / name)
    with inputs.confined(inside, inside.parents[1]), inputs.opened(inside / name) as source:
        os.replace(outside / name, inside / name)
        with source.reopened() as same:
            assert np.array_equal(images.read_pixels(same), own)
    assert not np.array_equal(images.read_pixels(inside / name), own)


def test_everything_that_a_capture_is_read_from_is_confined(folders):
    inside, outside = folders
    (inside / "x").mkdir()
    files = {"link.json": "../../../outside/a", "x/deep.json": "../../../../outside/a", "absolute.json": str(outside / "a")}
    (outside / "a").write_bytes(b"secret")
    for name, target in files.items():
        (inside / name).symlink_to(target)
        assert (inside / name).read_bytes() == b"secret"
    (inside / "folder").symlink_to(outside, target_is_directory=True)
    with inputs.confined(inside, inside.parents[1]):
        for name in (*files, "folder/a"):
            for read in (inputs.read_bytes, read_array, exr.read_header):
                with pytest.raises(StageError, match="leads out of the folder"):
                    read(inside / name)
    assert inputs.read_bytes(inside / "link.json") == b"secret"


def test_links_that_stay_in_the_folder_are_followed(folders):
    inside, _ = folders
    (inside / "step1").mkdir()
    (inside / "flat.exr").write_bytes(b"flat")
    (inside / "step1" / "flat.exr").symlink_to("../flat.exr")
    (inside / "step1" / "again.exr").symlink_to("./flat.exr")
    (inside / "last").symlink_to("step1", target_is_directory=True)
    (inside / "circle").symlink_to("circle")
    with inputs.confined(inside, inside.parents[1]):
        for name in ("flat.exr", "step1/flat.exr", "step1/again.exr", "last/again.exr"):
            assert inputs.read_bytes(inside / name) == b"flat"
        with pytest.raises(ManifestError, match="leads out"):
            inputs.read_bytes(inside / "circle")
        with pytest.raises(StorageError, match="no such file"):
            inputs.read_bytes(inside / "nothing")
        with pytest.raises(StageError):
            inputs.read_bytes(inside / "step1")


def test_a_pipe_is_no_file(folders):
    inside, _ = folders
    os.mkfifo(inside / "pipe.exr")
    with inputs.confined(inside, inside.parents[1]), pytest.raises(ManifestError, match=r"pipe\.exr: is no file"):
        inputs.read_bytes(inside / "pipe.exr")


@pytest.mark.parametrize("place", ["capture", "project"])
def test_a_folder_that_became_a_link_is_not_opened(folders, place):
    inside, outside = folders
    path = inside if place == "capture" else inside.parent
    path.rename(outside / "moved")
    path.symlink_to(outside / "moved", target_is_directory=True)
    with pytest.raises(ManifestError, match="a link leads to it"), inputs.confined(inside, inside.parents[1]):
        pass


def test_a_folder_that_was_opened_is_read_when_another_takes_its_place(folders):
    inside, outside = folders
    (inside / "a").write_bytes(b"own")
    (outside / "a").write_bytes(b"other")
    with inputs.confined(inside, inside.parents[1]):
        inside.rename(inside.with_name("moved"))
        inside.symlink_to(outside, target_is_directory=True)
        assert inputs.read_bytes(inside / "a") == b"own"
    assert inputs.read_bytes(inside / "a") == b"other"


@pytest.mark.parametrize(("name", "content"), [("a.png", lying_png(100, 100)), ("a.exr", lying_exr(100, 100))])
def test_an_image_of_too_many_pixels_is_not_decoded(folders, name, content):
    inside, _ = folders
    for suffix, write in WRITERS.items():
        write(inside / suffix, 100)
    with inputs.confined(inside, inside, max_pixels=SIDE**2 - 1):
        for suffix in WRITERS:
            with pytest.raises(ImageError, match=f"has {SIDE}x{SIDE} pixels, {SIDE**2 - 1} are allowed"):
                images.read_recorded(inside / suffix)
    with inputs.confined(inside, inside, max_pixels=SIDE**2):
        for suffix in WRITERS:
            assert images.read_recorded(inside / suffix).shape == (SIDE, SIDE, 3)
    (inside / name).write_bytes(content)
    with inputs.confined(inside, inside, max_pixels=9_999), pytest.raises(ImageError, match=name):
        images.read_recorded(inside / name)


@pytest.mark.long
def test_frames_that_are_swapped_for_links_while_they_are_read(folders):
    """What 22 of 24 tries did with the path: each stack has the frames of the capture, or the job fails."""
    inside, outside = folders
    write_capture(inside, make_scene(size=8, lights=5))
    foreign = outside / "002.exr"
    exr.write(foreign, dict.fromkeys("RGB", np.full((8, 8), 0.987, np.float16)), color_space="lin_rec709_scene", metadata={})
    own, ended = (inside / "002.exr").read_bytes(), threading.Event()

    def swap() -> None:
        while not ended.is_set():
            (inside / ".link").unlink(missing_ok=True)
            (inside / ".link").symlink_to(foreign)
            os.replace(inside / ".link", inside / "002.exr")
            (inside / ".own").write_bytes(own)
            os.replace(inside / ".own", inside / "002.exr")

    swapping = threading.Thread(target=swap)
    swapping.start()
    read = refused = 0
    try:
        for number in range(60):
            cache = outside / f"cache{number}"
            try:
                with inputs.confined(inside, inside.parents[1]):
                    found = open_stack(Capture.open(inside), cache=cache)
                radiance, _ = found.pick_radiance(np.arange(64))
                assert not np.isclose(radiance[2], 0.987, atol=1e-3).all()
                read += 1
            except StageError:
                refused += 1
    finally:
        ended.set()
        swapping.join()
    assert read + refused == 60 and refused > 0


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
def test_what_is_no_name(text):
    assert str(name_fault(text)).startswith("has ")
    with pytest.raises(ValidationError, match=r"leave it out|give 1000 or fewer"):
        TypeAdapter(Line).validate_python(text)


@pytest.mark.parametrize("text", ["", "owl", "x" * 1000, "Ünïcode 猫 🦉", "a b", "a\u200db", "\u2028"])
def test_other_characters_are(text):
    assert name_fault(text) is None and TypeAdapter(Line).validate_python(text) == text


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
@pytest.mark.parametrize(("change", "field"), [
    ({"name": "TEXT"}, "name"), ({"mask": "TEXT"}, "mask"), ({"frames": [{"image": "TEXT", "light": {"type": "off"}}]}, "frames[0].image"),
    ({"frames": [{"image": "a.exr", "light": {"type": "environment", "image": "TEXT"}}]}, "frames[0].light.image")])
def test_a_manifest_is_refused_by_file_and_field(tmp_path, text, change, field):
    path = tmp_path / "capture.json"
    path.write_text(json.dumps(manifest(["a.exr"]) | change).replace("TEXT", json.dumps(text)[1:-1]))
    with pytest.raises(ManifestError) as error:
        read_manifest(path)
    assert str(error.value).startswith(f"{path}: {field}: has ")


def test_half_a_character_as_bytes_is_refused(tmp_path):
    (tmp_path / "capture.json").write_bytes(json.dumps(manifest(["a.exr"])).encode().replace(b"small", b"\xed\xa0\x80"))
    with pytest.raises(ManifestError, match=r"capture\.json: name: has half a character"):
        read_manifest(tmp_path / "capture.json")


@pytest.mark.parametrize("text", [text for name, text in BAD.items() if name not in ("newline", "half", "byte")])
def test_a_line_of_an_lp_file_is_refused_by_number(tmp_path, text):
    (tmp_path / "a.lp").write_text(f"1\n{text}.png 0 0 1\n")
    with pytest.raises(ManifestError, match=r"a\.lp: line 2: "):
        lp.import_folder(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("field", ["tof_calibration", "capture", "name"])
@pytest.mark.parametrize("text", [text for name, text in BAD.items() if name in ("NUL", "newline", "escape")])
def test_a_request_is_refused(field, text):
    request = {"kind": "depth", "capture": "cap_0123456789abcdefghjk"}
    TypeAdapter(UserJob).validate_python(request)
    with pytest.raises(ValidationError):
        TypeAdapter(UserJob).validate_python(request | {field: text})


def models() -> list[type[BaseModel]]:
    for package in (stage, service.requests):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    found: list[type[BaseModel]] = [Strict, Options]
    for model in found:
        found += [each for each in model.__subclasses__() if not each.__module__.startswith("tests.")]  # as other tests make them
    return found


def bare_text(annotation: object, metadata: tuple[object, ...] = ()) -> bool:
    """Whether a type has a text in it that nothing checks."""
    if annotation is str:
        return not any(getattr(each, "pattern", None) or each in Line.__metadata__ or "pattern" in repr(each) for each in metadata)
    if hasattr(annotation, "__metadata__"):
        return bare_text(annotation.__origin__, annotation.__metadata__)  # type: ignore[attr-defined]
    return any(bare_text(part) for part in typing.get_args(annotation) if typing.get_origin(annotation) is not typing.Literal)


def test_every_text_of_a_manifest_or_a_request_is_checked():
    """Paths of the command line are left: the system allows any bytes in them."""
    assert bare_text(str) and bare_text(str | None) and bare_text(tuple[str, ...]) and not bare_text(Line) and not bare_text(Line | None)
    known = models()
    assert len(known) > 60
    unchecked = {f"{model.__name__}.{name}" for model in known for name, field in model.model_fields.items()
                 if Role.FILE not in field.metadata and bare_text(field.annotation, tuple(field.metadata))}
    commands = {"HttpRequest.url", "HttpRequest.body", "SerialController.on", "SerialController.off"}  # with line ends, of a rig's owner
    assert unchecked == commands


@pytest.mark.parametrize("content", [
    '{"schema": "LONG"}', '{"schema": ["LONG"]}', '{"schema": "relit.capture/1", "LONG": 1}', '{"LONG": 1, "LONG": 2}',
    '{"schema": "relit.capture/1", "name": "a", "frames": [{"image": "a", "light": {"type": "LONG"}}]}'])
def test_a_sentence_does_not_repeat_a_long_value(tmp_path, content):
    (tmp_path / "capture.json").write_text(content.replace("LONG", "x" * 100_000))
    with pytest.raises(ManifestError) as error:
        read_manifest(tmp_path / "capture.json")
    assert max(len(fault.removeprefix(str(tmp_path))) for fault in str(error.value).split("; ")) < 400


def test_a_number_that_no_float_holds_is_no_matrix(tmp_path):
    (tmp_path / "camera.json").write_text(f'{{"a": {10**400}, "b": [1, 2]}}')
    assert set(read_matrices(tmp_path / "camera.json")) == {"b"}
