"""AVIF images: their values, and their size before a pixel is decoded."""

import struct

import cv2
import numpy as np
import pytest

from stage import inputs
from stage.errors import ImageError
from stage.formats import avif
from stage.formats.images import read_header, read_pixels, read_recorded

RNG = np.random.default_rng(2)
CODES = np.repeat(np.repeat(RNG.integers(0, 256, (6, 8, 3)).astype(np.uint8), 8, axis=0), 8, axis=1)


def write_avif(path, codes, bits=8):
    """Without loss: the library keeps red, green and blue as they are at the highest quality."""
    order = codes if codes.ndim == 2 else codes[..., [2, 1, 0, *range(3, codes.shape[2])]]
    assert cv2.imwrite(str(path), order, [cv2.IMWRITE_AVIF_QUALITY, 100, cv2.IMWRITE_AVIF_DEPTH, bits])
    return path


@pytest.mark.parametrize("kind", ["colour", "grey", "alpha"])
def test_eight_bits_are_read_as_they_are(tmp_path, kind):
    codes = {"colour": CODES, "grey": CODES[..., 0], "alpha": np.concatenate([CODES, CODES[..., :1]], axis=-1)}[kind]
    path = write_avif(tmp_path / "a.avif", codes)
    header = read_header(path)
    assert (header.width, header.height, header.channels, header.integer) == (64, 48, 1 if kind == "grey" else 3, True)
    expected = np.repeat(codes[..., None], 3, axis=-1) if kind == "grey" else codes[..., :3]
    np.testing.assert_array_equal(read_recorded(path), expected)


@pytest.mark.parametrize("bits", [10, 12])
def test_deeper_images_are_fractions_of_their_full_scale(tmp_path, bits):
    full = (1 << bits) - 1
    codes = RNG.integers(0, full, (6, 8, 3), endpoint=True).astype(np.uint16)
    codes[0, 0], codes[0, 1] = 0, full
    codes = np.repeat(np.repeat(codes, 8, axis=0), 8, axis=1)
    pixels = read_pixels(write_avif(tmp_path / "a.avif", codes, bits))
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels, codes / full, atol=1e-6)


def test_damaged_files_are_one_quiet_sentence(tmp_path, capfd):
    data = write_avif(tmp_path / "a.avif", CODES).read_bytes()
    for length in (*range(0, len(data), 31), len(data) - 5):
        (tmp_path / "cut.avif").write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"cut\.avif: is (not an AVIF image|truncated)"):
            read_pixels(tmp_path / "cut.avif")
    middle = data.index(b"mdat") + 40
    (tmp_path / "bad.avif").write_bytes(data[:middle] + bytes(200) + data[middle + 200 :])
    with pytest.raises(ImageError, match=r"bad\.avif: cannot be decoded: its data is damaged"):
        read_pixels(tmp_path / "bad.avif")
    (tmp_path / "text.avif").write_text("no image")
    with pytest.raises(ImageError, match=r"text\.avif: is not an AVIF image"):
        read_header(tmp_path / "text.avif")
    assert capfd.readouterr().err == ""


def claiming(data, width, height):
    """The file with another size in its ispe boxes."""
    size = data[data.index(b"ispe") + 8 : data.index(b"ispe") + 16]
    return data.replace(b"ispe" + bytes(4) + size, b"ispe" + bytes(4) + struct.pack(">II", width, height))


def test_the_size_is_known_before_a_pixel_is_decoded(tmp_path):
    data = write_avif(tmp_path / "a.avif", CODES).read_bytes()
    path = tmp_path / "big.avif"
    path.write_bytes(claiming(data, 1 << 30, 1 << 29))
    assert read_header(path)[:2] == (1 << 30, 1 << 29)
    with inputs.confined(tmp_path, tmp_path, max_pixels=10_000), pytest.raises(ImageError, match="536870912 pixels, 10000 are allowed"):
        read_pixels(path)


def test_what_is_done_after_decoding_is_refused(tmp_path):
    """A turn: no writer here makes one, so the pixel information of the file becomes one."""
    data = write_avif(tmp_path / "a.avif", CODES).read_bytes()
    path = tmp_path / "turned.avif"
    path.write_bytes(data.replace(b"pixi", b"irot"))
    with open(path, "rb") as stream, pytest.raises(ImageError, match=r"turned\.avif: is to be turned, mirrored or cropped .*irot"):
        avif.header_of(path, stream)
