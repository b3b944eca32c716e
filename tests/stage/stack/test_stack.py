"""The stack of a capture: taken early, read in bands, partly replaced, with its checksums; hashes of files."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import StorageError
from stage.stack import planes as stage_planes
from stage.stack import stack
from stage.stack.early import EarlyStack
from stage.stack.fingerprint import Fingerprints, digest
from stage.stack.ingest import CACHE_FOLDER, Ingest, open_stack
from stage.stack.planes import frame_planes
from stage.stack.stack import ReplacedStack, Stack, index_path, saturated_path, values_path
from stage.stack.stack_file import StackFile
from tests.scenes.captures import edit_manifest, files_in, make_scene, write_capture, write_exr

LIGHTS = 11
SATURATION = 0.5 * float(make_scene(size=9, lights=LIGHTS).images.max())
SCENE = make_scene(size=12, lights=4)
CACHED = make_scene(size=9, lights=5)


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


@pytest.fixture
def capture(tmp_path):
    rng = np.random.default_rng(0)
    write_capture(tmp_path, saturation=0.9, dark="dark.exr", frames=[
        {"image": f"{i}.exr", "exposure_s": 0.5, "pattern": {"code": code}} for i, code in enumerate(("black", "white"))])
    write_exr(tmp_path / "dark.exr", np.full((16, 16, 3), 0.1))
    for i in range(2):
        write_exr(tmp_path / f"{i}.exr", 0.2 + rng.random((16, 16, 3)))
    return Capture.open(tmp_path)


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("memory", [True, False])
def test_planes_hold_corrected_frames(capture, monkeypatch, colour, memory):
    from stage.formats import exr

    before = files_in(capture.folder)
    if not memory:
        monkeypatch.setattr(stage_planes, "MEMORY_BYTES", 0)
    monkeypatch.setattr(stage_planes, "BAND_BYTES", 16 * 4 * 2 * 5)
    with frame_planes(capture, capture.manifest.frames, colour=colour) as planes:
        bands = list(planes.bands())
        values = np.concatenate([planes.band(rows, [1]) for rows in bands], axis=-1)
        channels, _ = exr.read(capture.folder / "1.exr")
        recorded = np.stack([channels[name] for name in "RGB"])
        truth = (recorded - np.float32(0.1)) / 0.5
        truth = truth if colour else np.tensordot(GREY_WEIGHTS, truth, 1)[None]
        assert len(bands) > 1 and np.allclose(values[0], truth.reshape(len(truth), -1), atol=1e-6)
        assert (planes.saturated[1] == (recorded >= 0.9).any(axis=0)).all()
    assert files_in(capture.folder) == before


def test_a_folder_that_cannot_be_made_is_named(capture, monkeypatch):
    monkeypatch.setattr(stage_planes, "MEMORY_BYTES", 0)
    with pytest.raises(StorageError, match=r"0\.exr"), frame_planes(capture, capture.manifest.frames, colour=False,
                                                                  cache=capture.folder / "0.exr"):
        pass


def test_replaced_readings_are_the_new_ones_and_others_stay(tmp_path):
    """Also values far above the range that the image had; in bands and single pixels."""
    write_capture(tmp_path, SCENE)
    stack = open_stack(Capture.open(tmp_path))
    pixel, light = np.array([90, 20, 20]), np.array([1, 0, 3])
    new = np.float32([[40, 0.5, 0.25], [50, 0.5, 0.5], [60, 0.5, 1]])
    replaced = ReplacedStack.of(stack, pixel, light, new)
    expected = stack.band(0, stack.shape[2]).astype(float) * stack.scale[:, None]
    expected[:, light, pixel] = new
    got = replaced.band(0, stack.shape[2]).astype(float) * replaced.scale[:, None]
    np.testing.assert_allclose(got, expected, rtol=2.0**-11, atol=1e-7)  # half rounding
    chosen = np.array([90, 3, 20, 21])
    np.testing.assert_array_equal(replaced.pick(chosen)[0], replaced.band(0, stack.shape[2])[:, :, chosen])
    np.testing.assert_array_equal(replaced.band(64, 128), replaced.band(0, 192)[:, :, 64:128])


def test_the_hash_follows_the_content_not_the_name_or_the_time(tmp_path):
    for name, content in (("a", b"same"), ("b", b"same"), ("c", b"other")):
        (tmp_path / name).write_bytes(content)
    hashes = Fingerprints(tmp_path, tmp_path / "memory.json").of(["a", "b", "c"])
    assert hashes["a"] == hashes["b"] != hashes["c"]
    os.utime(tmp_path / "a", ns=(1, 1))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"])["a"] == hashes["a"]


def test_an_unchanged_file_is_not_read_again(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    first = Fingerprints(tmp_path, tmp_path / "memory.json")
    known = first.of(["a"])
    first.remember()
    stamp = path.stat().st_mtime_ns
    path.write_bytes(b"other")  # same size; with the same time it passes for the same file: that is the bargain
    os.utime(path, ns=(stamp, stamp))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) == known
    os.utime(path, ns=(stamp, stamp + 1))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) != known


@pytest.mark.parametrize("memory", ["", "{", "[]", "null", '{"a": 3}', '{"a": []}'])
def test_a_damaged_memory_is_only_a_slower_start(tmp_path, memory):
    (tmp_path / "a").write_bytes(b"x")
    clean = Fingerprints(tmp_path, tmp_path / "none.json").of(["a"])
    (tmp_path / "memory.json").write_text(memory)
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) == clean


def test_the_hash_of_one_file(tmp_path):
    (tmp_path / "a").write_bytes(b"content")
    assert digest(tmp_path / "a") == Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"])["a"]
    for read in (digest, lambda path: Fingerprints(tmp_path, tmp_path / "memory.json").of([path.name])):
        with pytest.raises(StorageError, match=r"cannot read .*gone: no such file"):
            read(tmp_path / "gone")


@pytest.fixture
def written(tmp_path: Path) -> Capture:
    write_capture(tmp_path, CACHED)
    edit_manifest(tmp_path, saturation=float(np.quantile(CACHED.images, 0.9)))  # so that there are saturation bits
    return Capture.open(tmp_path)


def content(found: Stack) -> list[bytes]:
    return [found.band(0, 128).tobytes(), found.saturated(0, 128).tobytes(), found.scale.tobytes()]


def files(found: Stack) -> dict[str, Path]:
    return {"values": stack.values_path(found.folder, found.key), "bits": stack.saturated_path(found.folder, found.key),
            "index": stack.index_path(found.folder, found.key)}


def flipped(place):
    return lambda data: data[:int(place * len(data))] + bytes([data[int(place * len(data))] ^ 1]) + data[int(place * len(data)) + 1:]


DAMAGES = {**{f"flipped at {place}": flipped(place) for place in (0.0, 0.03, 0.1, 0.5, 0.9, 0.999)},
           **{f"cut to {kept} bytes": lambda data, kept=kept: data[:kept] for kept in (0, 10, 200)}, "gone": lambda data: None,
           **{f"{text} in its place": lambda data, text=text: text.encode() for text in ("{", "[]", "{}", "null")}}


@pytest.mark.parametrize("name", ["values", "bits", "index"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_of_the_cache_is_made_again(written, name, damage):
    found = open_stack(written)
    good, path = content(found), files(found)[name]
    damaged = DAMAGES[damage](path.read_bytes())
    if damaged is None:
        path.unlink()
    else:
        path.write_bytes(damaged)
    assert content(open_stack(written)) == good
    assert path.read_bytes() != damaged


def test_a_bit_of_every_plane_is_found(written):
    """The padding too: padded lights have the scale 0, and 0 times what is no number is no number."""
    found = open_stack(written)
    good, path = content(found), files(found)["values"]
    whole = path.read_bytes()
    start = len(whole) - 2 * int(np.prod(found.shape))
    for plane in range(found.shape[0] * found.shape[1]):
        damaged = bytearray(whole)
        damaged[start + 256 * plane + (17 * plane) % 256] ^= 0x80
        path.write_bytes(damaged)
        assert content(open_stack(written)) == good
        assert path.read_bytes() == whole


def test_bits_that_do_not_belong_to_the_stack_are_not_read(tmp_path):
    written = Capture.open(write_capture(tmp_path, CACHED))
    found = open_stack(written)
    good, bits = content(found), files(found)["bits"]
    assert not bits.exists()
    np.save(bits, np.full((1, 128), 255, np.uint8))
    assert content(open_stack(written)) == good and not bits.exists()


def test_a_sound_cache_is_read_as_it_is(written):
    found = open_stack(written)
    before = {name: (path.stat().st_ino, path.stat().st_mtime_ns) for name, path in files(found).items()}
    assert content(open_stack(written)) == content(found)
    assert {name: (path.stat().st_ino, path.stat().st_mtime_ns) for name, path in files(found).items()} == before
    assert len(json.loads(files(found)["index"].read_text())["checksums"]["values"]) == 3 * 8
