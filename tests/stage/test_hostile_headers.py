"""Headers that lie or are broken: refused by the file's name, and before what they claim is asked of the memory."""

import json
import random
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from stage.capture.manifest import read_manifest
from stage.errors import ImageError, ManifestError, StageError
from stage.formats import exr, integrity
from stage.tof.raw_frames import read_array
from tests.service.server.api.captures import lying_exr, lying_jxl, lying_npy, manifest

MIB = 1 << 20


@pytest.mark.long
@pytest.mark.parametrize("size", [(8, 8), (100, 37), (640, 480), (3000, 3)])
@pytest.mark.parametrize("bare", [False, True])
def test_the_size_of_a_jxl_is_read_without_decoding_it(tmp_path, size, bare):
    path = tmp_path / "a.jxl"
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), oiio.ImageSpec(*size, 3, "uint8"))
    assert out.write_image(np.zeros((size[1], size[0], 3), np.uint8))
    out.close()
    content = path.read_bytes()
    if bare:  # the codestream alone, as far as its size is
        path.write_bytes(content[content.index(integrity.CODESTREAM):])
    assert integrity.jxl_resolution(path) == size
    for length in (0, 1, 12, 20, len(content) - len(content[content.index(integrity.CODESTREAM):]) + 3):
        path.write_bytes(content[:length])
        with pytest.raises(ImageError, match=r"a\.jxl"):
            integrity.jxl_resolution(path)


def test_a_jxl_may_claim_any_size(tmp_path):
    (tmp_path / "a.jxl").write_bytes(lying_jxl(1 << 30, 1 << 29))
    assert integrity.jxl_resolution(tmp_path / "a.jxl") == (1 << 30, 1 << 29)


@pytest.mark.parametrize("content", [
    lying_exr(32768, 32768), lying_exr(32768, 32768, 1), lying_exr(1 << 30, 1), lying_exr(64, 64).replace(b"B\0", b"\xff\0", 1)])
def test_an_exr_header_is_refused_in_little_memory(tmp_path, content):
    (tmp_path / "a.exr").write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ImageError, match=r"a\.exr"):
            exr.read_header(tmp_path / "a.exr")
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def many(content: bytes, count: int, what: str) -> bytes:
    """The header of `lying_exr` with so many more channels, attributes or parts, or with one attribute of so many bytes."""
    if what == "channels":
        end = content.index(b"compression\0")
        entries = b"".join(f"x{number}".encode() + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for number in range(count))
        return content[:8] + attribute("channels", "chlist", entries + b"\0") + content[end:]
    if what == "attributes":
        return content[:8] + b"".join(attribute(f"a{number}", "int", bytes(4)) for number in range(count)) + content[8:]
    if what == "parts":
        return content[:5] + b"\x10" + content[6:8] + count * (content[8:-64]) + bytes(65)
    return content[:8] + attribute("a", "string", bytes(count)) + content[8:]


@pytest.mark.parametrize(("what", "count", "words"), [
    ("channels", 100_000, "has more than 1024 channels"), ("attributes", 200_000, "has more than 4000 attributes in its header"),
    ("parts", 10_000, "has more than 256 parts"), ("bytes", 5 << 20, "has a header that is damaged, or longer than 4 MiB")])
def test_a_long_exr_header_is_not_read_whole(tmp_path, monkeypatch, what, count, words):
    """The library takes 21 s for the channels and 49 s for the attributes."""
    path = tmp_path / "a.exr"
    path.write_bytes(many(lying_exr(64, 64), 3, what))
    with pytest.raises(ImageError, match="truncated"):  # as it is read on
        exr.read_header(path)
    path.write_bytes(many(lying_exr(64, 64), count, what))
    monkeypatch.setattr(exr.OpenEXR, "File", lambda *_, **__: pytest.fail("the header was read whole"))
    with pytest.raises(ImageError, match=words):
        exr.read_header(path)


def test_fuzzed_exr_headers_are_refused_or_read(tmp_path):
    path = tmp_path / "a.exr"
    exr.write(path, {"R": np.zeros((4, 4), np.float16)}, color_space="lin_rec709_scene", metadata={"note": "fuzz"})
    good, numbers = path.read_bytes(), random.Random(0)
    for _ in range(500):
        bad = bytearray(good)
        for _ in range(numbers.choice((1, 2, 8))):
            bad[numbers.randrange(len(bad))] = numbers.choice((0, 127, 128, 255, numbers.randrange(256)))
        path.write_bytes(bad)
        try:
            exr.read_header(path)
        except StageError as error:
            assert "a.exr" in str(error)


@pytest.mark.parametrize("shape", ["(8, 8", "__import__('os')", "(-8, 8)", "(1,) * 99", "(8, 8)"])
def test_an_array_header_that_is_no_shape_is_refused(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(lying_npy(shape))
    with pytest.raises(ImageError, match=r"a\.npy"):
        read_array(tmp_path / "a.npy")


FAULTS = 100_000


@pytest.mark.parametrize(("field", "entry"), [("frames", "0"), ("frames", "[]"), ("frames", "{}"), ("directions", "0")])
def test_of_many_faults_the_first_is_told(tmp_path, field, entry):
    """Told all, they would take a kilobyte each: of a million entries a gigabyte, of these 100 MB."""
    many = f"[{','.join([entry] * FAULTS)}]"
    whole = manifest([])
    if field == "directions":
        whole["frames"] = [{"image": "a", "light": {"type": "extended", "directions": "MANY", "radiance": [[1, 1, 1]], "solid_angle": [1]}}]
    else:
        whole["frames"] = "MANY"
    path = Path(tmp_path / "capture.json")
    path.write_text(json.dumps(whole).replace('"MANY"', many))
    tracemalloc.start()
    try:
        with pytest.raises(ManifestError, match=rf"capture\.json: frames\[0\].*{'directions' if field == 'directions' else ''}"):
            read_manifest(path)
        assert tracemalloc.get_traced_memory()[1] < 200 * FAULTS  # bytes: an object of Python each, and the text
    finally:
        tracemalloc.stop()


def test_an_object_has_not_any_number_of_keys(tmp_path):
    (tmp_path / "capture.json").write_text(json.dumps({f"key{number}": 0 for number in range(1001)}))
    with pytest.raises(ManifestError, match="more than 1000 keys"):
        read_manifest(tmp_path / "capture.json")
