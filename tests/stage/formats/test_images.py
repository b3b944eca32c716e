"""Images of every format, AVIF among them, are read as what they say, or refused in a sentence."""

import struct

import cv2
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from stage import inputs
from stage.errors import ImageError, StorageError
from stage.formats import avif
from stage.formats.images import check_resolution, fractions, read_header, read_mask, read_pixels, read_recorded
from stage.formats.integrity import check_jpeg
from stage.importers.layout import color_space_of
from tests.scenes.captures import write_exr, write_image

RNG = np.random.default_rng(7)
UNIT = RNG.random((5, 7, 3))
AVIF_RNG = np.random.default_rng(2)
CODES = np.repeat(np.repeat(AVIF_RNG.integers(0, 256, (6, 8, 3)).astype(np.uint8), 8, axis=0), 8, axis=1)


@pytest.mark.parametrize("suffix", ["png", "tif", "dpx", "jxl"])
@pytest.mark.parametrize(("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535)])
def test_integers_are_fractions_of_full_scale(tmp_path, suffix, dtype, full):
    codes = RNG.integers(0, full, (5, 7, 3), endpoint=True).astype(dtype)
    codes[0, 0], codes[0, 1] = 0, full
    pixels = read_pixels(write_image(tmp_path / f"a.{suffix}", codes))
    assert read_header(tmp_path / f"a.{suffix}") [:5] == (7, 5, 3, 3, True)
    assert pixels.dtype == np.float32
    # codes / full in float32: half a unit in the last place either way
    assert np.allclose(pixels, codes / full, rtol=1.2e-7, atol=0)
    assert (pixels[0, 0] == 0).all() and (pixels[0, 1] == 1).all()


@pytest.mark.parametrize("suffix", ["png", "tif", "dpx"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_every_integer_is_read_as_it_is_and_stands_for_the_fraction_that_its_library_gives(tmp_path, suffix, dtype):
    every = np.arange(np.iinfo(dtype).max + 1, dtype=dtype).reshape(16, -1)
    path = write_image(tmp_path / f"a.{suffix}", np.stack([every] * 3, axis=-1))
    recorded = read_recorded(path)
    assert recorded.dtype == dtype
    assert (recorded == every[..., None]).all()
    library = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    assert np.array_equal(fractions(np.dtype(dtype))[every], library[..., 0])


@pytest.mark.parametrize("suffix", ["tga", "bmp"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_every_code_of_tga_and_bmp_is_read(tmp_path, suffix, channels):
    """BMP has no alpha that its readers agree on."""
    if (suffix, channels) == ("bmp", 4):
        pytest.skip("no such files")
    codes = RNG.integers(0, 256, (16, 48, channels)).astype(np.uint8)
    path = write_image(tmp_path / f"a.{suffix}", codes)
    header = read_header(path)
    assert (header.width, header.height, header.integer) == (48, 16, True)
    assert np.array_equal(read_recorded(path), np.repeat(codes, 3, axis=-1) if channels == 1 else codes[..., :3])


def test_compressed_tga_of_any_origin(tmp_path):
    codes = np.repeat(RNG.integers(0, 256, (16, 12, 3)).astype(np.uint8), 4, axis=1)
    path = write_image(tmp_path / "a.tga", codes, compression="rle")
    data = bytearray(path.read_bytes())
    assert data[2] == 10  # run-length encoded
    assert np.array_equal(read_recorded(path), codes)
    data[17] ^= 0x20  # the origin, of the image descriptor: top or bottom
    path.write_bytes(data)
    assert np.array_equal(read_recorded(path), codes[::-1])
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError, match=r"a\.tga: cannot be "):
        read_recorded(path)


def test_float_tiff_keeps_its_bits(tmp_path):
    values = (UNIT * 1000).astype(np.float32)
    assert np.array_equal(read_pixels(write_image(tmp_path / "a.tif", values)), values)
    assert not read_header(tmp_path / "a.tif").integer


def test_hdr_is_right_to_its_eight_bit_mantissa(tmp_path):
    values = (0.5 + UNIT * 20).astype(np.float32)
    pixels = read_pixels(write_image(tmp_path / "a.hdr", values))
    # shared exponent: the step is 1/128 of the largest channel's power of two
    assert (np.abs(pixels - values) <= values.max(axis=-1, keepdims=True) / 128).all()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_keeps_bits_and_type(tmp_path, dtype):
    values = (UNIT * 9 - 1).astype(dtype)
    pixels = read_pixels(write_exr(tmp_path / "a.exr", values, dtype))
    assert pixels.dtype == dtype
    assert np.array_equal(pixels, values)


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.tif"])
def test_grey_repeats_its_channel(tmp_path, name):
    codes = RNG.integers(0, 255, (4, 6)).astype(np.uint8)
    path = write_exr(tmp_path / name, codes / 255) if name.endswith("exr") else write_image(tmp_path / name, codes)
    pixels = read_pixels(path)
    assert pixels.shape == (4, 6, 3)
    assert np.allclose(pixels, codes[..., None] / 255, rtol=1.2e-7)
    assert read_header(path)[:5] == (6, 4, 1, 1, not name.endswith("exr"))


def test_alpha_is_dropped_and_not_multiplied(tmp_path):
    codes = RNG.integers(0, 255, (4, 6, 4)).astype(np.uint8)
    pixels = read_pixels(write_image(tmp_path / "a.png", codes))
    assert np.allclose(pixels, codes[..., :3] / 255, rtol=1.2e-7)
    two = codes[..., :2].copy()
    assert np.allclose(read_pixels(write_image(tmp_path / "b.png", two)), two[..., :1] / 255, rtol=1.2e-7)
    values = np.concatenate([UNIT, np.full((5, 7, 1), 0.5)], axis=-1).astype(np.float32)
    path = write_exr(tmp_path / "a.exr", values)
    assert np.array_equal(read_pixels(path), values[..., :3])
    assert read_header(path)[:5] == (7, 5, 3, 4, False)


def test_the_only_layer_of_an_exr_is_read(tmp_path):
    """As programs write their render passes."""
    def write(name, *layers):
        planes = {f"{layer}.{letter}": UNIT[..., index].astype(np.float32) for layer in layers for index, letter in enumerate("RGB")}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {**planes, "Depth.Z": UNIT[..., 0].astype(np.float32)}).write(str(tmp_path / name))
        return tmp_path / name

    assert np.array_equal(read_pixels(write("one.exr", "View.Combined")), UNIT.astype(np.float32))
    with pytest.raises(ImageError, match="an image needs R, G, B, in one layer"):
        read_pixels(write("two.exr", "Diffuse", "Gloss"))


def profile(description):
    """An ICC profile of which nothing but its description is set."""
    text = description.encode() + b"\0"
    tag = (b"desc" + bytes(4) + struct.pack(">I", len(text)) + text).ljust(112, b"\0")
    head = struct.pack(">I4sI12s", 144 + len(tag), b"lcms", 0x02100000, b"mntrRGB XYZ ") + bytes(12) + b"acsp" + bytes(88)
    return head + struct.pack(">I4sII", 1, b"desc", 144, len(tag)) + tag


@pytest.mark.parametrize(("description", "space"), [
    ("sRGB IEC61966-2.1", "srgb_rec709_scene"), ("Adobe RGB (1998)", "g22_adobergb_scene"), ("Display P3", "srgb_p3d65_scene"),
    ("Gray Gamma 2.2", "g22_rec709_scene"), ("sRGB Linear", "lin_rec709_scene"), ("RTv4_Large_g10", ""), ("ProPhoto RGB", ""),
    ("Canon EOS 5D", "")])
def test_an_icc_profile_tells_the_colour_space(tmp_path, description, space):
    """16-bit images of photo programs are encoded."""
    path = tmp_path / "a.tif"
    spec, content = oiio.ImageSpec(7, 5, 3, "uint16"), profile(description)
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(content)}]"), np.frombuffer(content, np.uint8))
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.zeros((5, 7, 3), np.uint16)) and output.close()
    header = read_header(path)
    assert header.space == space and ("ProPhoto RGB" in header.encoding) == ("ProPhoto" in description)
    assert color_space_of(path) == (space or "lin_rec709_scene")


def test_channels_that_are_no_colour_are_named(tmp_path):
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"u": np.zeros((2, 2), np.float32), "v": np.zeros((2, 2), np.float32)}).write(
        str(tmp_path / "a.exr"))
    with pytest.raises(ImageError, match="has channels u, v: an image needs R, G, B, in one layer"):
        read_header(tmp_path / "a.exr")
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"id": np.zeros((2, 2), np.uint32)}).write(str(tmp_path / "b.exr"))
    with pytest.raises(ImageError, match="integer identifiers"):
        read_pixels(tmp_path / "b.exr")


@pytest.mark.parametrize("names", ["XYZ", ("BY", "RY", "Y")], ids=["tristimulus", "chroma"])
def test_colours_that_are_not_red_green_and_blue_are_not_taken_for_grey(tmp_path, names):
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
                 {name: np.full((5, 7), 0.5, np.float32) for name in names}).write(str(tmp_path / "a.exr"))
    for read in (read_header, read_pixels):
        with pytest.raises(ImageError, match=f"a.exr: has channels {', '.join(names)}, of which Y alone is grey: convert"):
            read(tmp_path / "a.exr")
    write_exr(tmp_path / "grey.exr", UNIT[..., 0])
    assert read_header(tmp_path / "grey.exr").channels == 1


@pytest.mark.parametrize("suffix", ["png", "tif", "hdr", "bmp"])
def test_damaged_files_are_one_quiet_sentence(tmp_path, capfd, suffix):
    values = UNIT.repeat(20, axis=0).repeat(20, axis=1)
    recorded = values.astype(np.float32) if suffix == "hdr" else (values * 65535).astype(np.uint16)
    recorded = (values * 255).astype(np.uint8) if suffix == "bmp" else recorded
    whole = write_image(tmp_path / f"whole.{suffix}", recorded)
    data = whole.read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 30):
        cut = tmp_path / f"cut.{suffix}"
        cut.write_bytes(data[:length])
        with pytest.raises(ImageError) as caught:
            read_pixels(cut)
        assert str(caught.value).startswith((f"{cut}: cannot be ", f"{cut}: is truncated", f"{cut}: is not a PNG"))
        assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_flipped_bit_in_a_png_is_one_quiet_sentence(tmp_path, capfd):
    path = write_image(tmp_path / "a.png", (UNIT * 255).astype(np.uint8))
    data = bytearray(path.read_bytes())
    data[-30] ^= 1
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"a\.png: cannot be decoded: its data is damaged"):
        read_pixels(path)
    assert capfd.readouterr().err == ""


def test_a_short_png_is_known_by_its_header(tmp_path):
    path = write_image(tmp_path / "a.png", (UNIT * 255).astype(np.uint8))
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"a\.png: is (truncated|not a PNG)"):
            read_header(path)


@pytest.mark.parametrize("quality", ["jpeg:50", "jpeg:95"])
def test_a_short_jpeg_is_not_filled_with_grey(tmp_path, capfd, quality):
    path = tmp_path / "a.jpg"
    spec = oiio.ImageSpec(96, 64, 3, "uint8")
    spec.attribute("Compression", quality)
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(RNG.integers(0, 255, (64, 96, 3)).astype(np.uint8))
    output.close()
    data = path.read_bytes()
    path.write_bytes(data + b"\0" * 100)  # cameras append previews and padding
    assert read_pixels(path).shape == (64, 96, 3)
    for length in [*range(0, len(data), 97), len(data) - 2, len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"a\.jpg: is (truncated|not a JPEG)"):
            read_pixels(path)
    assert capfd.readouterr().err == ""


def test_a_thumbnail_inside_a_jpeg_is_not_its_end(tmp_path):
    """An EXIF segment holds a JPEG of its own, end marker and all."""
    data = write_image(tmp_path / "a.jpg", (UNIT * 255).astype(np.uint8)).read_bytes()
    thumbnail = b"Exif\0\0" + data
    with_thumbnail = data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]
    with open(path := write_bytes(tmp_path / "whole.jpg", with_thumbnail), "rb") as stream:
        check_jpeg(path, stream)
    with open(path := write_bytes(tmp_path / "cut.jpg", with_thumbnail[:-2]), "rb") as stream, \
            pytest.raises(ImageError, match=r"cut\.jpg: is truncated"):
        check_jpeg(path, stream)


def write_bytes(path, data):
    path.write_bytes(data)
    return path


def test_unknown_suffixes_and_missing_files(tmp_path):
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(ImageError, match=r"a\.txt: has an unknown suffix"):
        read_header(tmp_path / "a.txt")
    for name in ("none.png", "none.exr"):
        with pytest.raises(StorageError, match=rf"cannot read .*{name}: no such file"):
            read_pixels(tmp_path / name)


def test_the_size_is_checked_by_the_header(tmp_path):
    path = write_image(tmp_path / "a.png", np.zeros((4, 6), np.uint8))
    check_resolution(path, (6, 4))
    with pytest.raises(ImageError, match=r"a\.png: is 6x4, camera\.resolution says 4x6"):
        check_resolution(path, (4, 6))


def test_masks(tmp_path):
    codes = np.array([[0, 127, 128, 255]], np.uint8)
    assert read_mask(write_image(tmp_path / "m.png", codes), (4, 1)).tolist() == [[False, False, True, True]]
    with pytest.raises(ImageError, match=r"empty\.png: the mask is empty"):
        read_mask(write_image(tmp_path / "empty.png", codes // 4), (4, 1))
    with pytest.raises(ImageError, match=r"is 4x1, camera\.resolution says 1x4"):
        read_mask(tmp_path / "m.png", (1, 4))


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
    codes = AVIF_RNG.integers(0, full, (6, 8, 3), endpoint=True).astype(np.uint16)
    codes[0, 0], codes[0, 1] = 0, full
    codes = np.repeat(np.repeat(codes, 8, axis=0), 8, axis=1)
    pixels = read_pixels(write_avif(tmp_path / "a.avif", codes, bits))
    assert pixels.dtype == np.float32
    np.testing.assert_allclose(pixels, codes / full, atol=1e-6)


def test_damaged_avif_files_are_one_sentence(tmp_path, capfd):
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
