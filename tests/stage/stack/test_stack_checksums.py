"""A damaged stack cache is made again before anything is read from it: it gives neither other values nor an error."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.stack import stack
from stage.stack.ingest import open_stack
from stage.stack.stack import Stack
from tests.scenes.captures import edit_manifest, make_scene, write_capture

SCENE = make_scene(size=9, lights=5)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    write_capture(tmp_path, SCENE)
    edit_manifest(tmp_path, saturation=float(np.quantile(SCENE.images, 0.9)))  # so that there are saturation bits
    return Capture.open(tmp_path)


def content(found: Stack) -> list[bytes]:
    return [found.band(0, 128).tobytes(), found.saturated(0, 128).tobytes(), found.scale.tobytes()]


def files(found: Stack) -> dict[str, Path]:
    return {"values": stack.values_path(found.folder, found.key), "bits": stack.saturated_path(found.folder, found.key),
            "index": stack.index_path(found.folder, found.key)}


@pytest.mark.parametrize("name", ["values", "bits", "index"])
@pytest.mark.parametrize("place", [0.0, 0.03, 0.1, 0.5, 0.9, 0.999], ids=str)
def test_a_flipped_bit_is_mended(capture, name, place):
    found = open_stack(capture)
    good, path = content(found), files(found)[name]
    damaged = bytearray(path.read_bytes())
    damaged[int(place * len(damaged))] ^= 1
    path.write_bytes(damaged)
    assert content(open_stack(capture)) == good
    assert path.read_bytes() != damaged


def test_a_bit_of_every_plane_is_found(capture):
    """The padding too: padded lights have the scale 0, and 0 times what is no number is no number."""
    found = open_stack(capture)
    good, path = content(found), files(found)["values"]
    whole = path.read_bytes()
    start = len(whole) - 2 * int(np.prod(found.shape))
    for plane in range(found.shape[0] * found.shape[1]):
        damaged = bytearray(whole)
        damaged[start + 256 * plane + (17 * plane) % 256] ^= 0x80
        path.write_bytes(damaged)
        assert content(open_stack(capture)) == good
        assert path.read_bytes() == whole


@pytest.mark.parametrize("name", ["values", "bits", "index"])
@pytest.mark.parametrize("kept", [0, 10, 200])
def test_a_file_that_was_cut_short_is_made_again(capture, name, kept):
    found = open_stack(capture)
    good, path = content(found), files(found)[name]
    os.truncate(path, kept)
    assert content(open_stack(capture)) == good


def test_bits_that_do_not_belong_to_the_stack_are_not_read(tmp_path):
    capture = Capture.open(write_capture(tmp_path, SCENE))
    found = open_stack(capture)
    good, bits = content(found), files(found)["bits"]
    assert not bits.exists()
    np.save(bits, np.full((1, 128), 255, np.uint8))
    assert content(open_stack(capture)) == good and not bits.exists()


def test_a_sound_cache_is_read_as_it_is(capture):
    found = open_stack(capture)
    before = {name: (path.stat().st_ino, path.stat().st_mtime_ns) for name, path in files(found).items()}
    assert content(open_stack(capture)) == content(found)
    assert {name: (path.stat().st_ino, path.stat().st_mtime_ns) for name, path in files(found).items()} == before
    assert len(json.loads(files(found)["index"].read_text())["checksums"]["values"]) == 3 * 8
