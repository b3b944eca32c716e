"""Camera raw files: values stay linear, black and white are those of the file, and colours between pixels are bilinear."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError
from stage.formats import camera_raw
from stage.formats.exif import TURNS, Exposure, upright
from stage.formats.images import read_header, read_pixels
from stage.importers.camera_options import Selection
from stage.importers.olat import import_photos
from stage.stack.correction import Correction
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_image
from tests.scenes.dng import RGGB, write_dng

pytest.importorskip("rawpy")
BLACK, WHITE = (512, 520, 516, 530), 15000
RNG = np.random.default_rng(7)
ROWS, COLS = 24, 32
PLACE = 2 * (np.arange(ROWS)[:, None] % 2) + np.arange(COLS) % 2  # of each pixel in the mosaic
OWN = np.array(RGGB)[PLACE]
LEVELS = np.array(BLACK)[PLACE]
FLOAT32 = 3e-7  # a subtraction and a division in float32, of values up to one


def scaled(mosaic):
    return (mosaic.astype(np.float64) - LEVELS) / (WHITE - LEVELS)


def test_own_colours_are_the_counts_above_black_over_white(tmp_path):
    mosaic = RNG.integers(600, 14900, (ROWS, COLS)).astype(np.uint16)
    mosaic[:2] = 500  # below black
    write_dng(tmp_path / "a.DNG", mosaic, exposure_s=1 / 60)
    pixels = read_pixels(tmp_path / "a.DNG")
    assert (pixels.dtype, pixels.shape) == (np.float32, (ROWS, COLS, 3))
    own = np.take_along_axis(pixels, OWN[..., None], axis=2)[..., 0]
    np.testing.assert_allclose(own, scaled(mosaic), atol=FLOAT32)
    assert (own < 0).any()
    header = read_header(tmp_path / "a.DNG")
    assert (header.width, header.height, header.channels, header.integer) == (COLS, ROWS, 3, True)
    assert header.exposure == Exposure(pytest.approx(1 / 60, rel=1e-4), 5.6, 200)  # whole microseconds


def test_missing_colours_are_bilinear(tmp_path):
    """Written out for single pixels; a plane stays a plane away from the border."""
    mosaic = RNG.integers(600, 14900, (ROWS, COLS)).astype(np.uint16)
    write_dng(tmp_path / "a.dng", mosaic)
    pixels, value = read_pixels(tmp_path / "a.dng"), scaled(mosaic)
    across, around = value[4, [3, 5]].mean(), value[[3, 5, 4, 4], [4, 4, 3, 5]].mean()  # of the red pixel 4, 4
    diagonal = value[[3, 3, 5, 5], [3, 5, 3, 5]].mean()
    np.testing.assert_allclose(pixels[4, 4], [value[4, 4], around, diagonal], atol=FLOAT32)
    np.testing.assert_allclose(pixels[4, 5], [value[4, [4, 6]].mean(), value[4, 5], value[[3, 5], 5].mean()], atol=FLOAT32)
    np.testing.assert_allclose(pixels[4, 3, 0], value[4, [2, 4]].mean(), atol=FLOAT32)
    assert across != around
    rows, cols = np.mgrid[:ROWS, :COLS]
    plane = 0.1 + 0.01 * cols + 0.02 * rows
    write_dng(tmp_path / "b.dng", np.rint(LEVELS + plane * (WHITE - LEVELS)).astype(np.uint16))
    half_a_count = 0.5 / (WHITE - max(BLACK)) + FLOAT32
    assert np.abs(read_pixels(tmp_path / "b.dng") - plane[..., None])[1:-1, 1:-1].max() < half_a_count


@pytest.mark.parametrize("orientation", TURNS)
def test_images_are_upright(tmp_path, orientation):
    mosaic = RNG.integers(600, 14900, (ROWS, COLS)).astype(np.uint16)
    for name, turned in (("plain", 1), ("turned", orientation)):
        write_dng(tmp_path / f"{name}.dng", mosaic, orientation=turned)
    expected = upright(read_pixels(tmp_path / "plain.dng"), orientation)
    np.testing.assert_array_equal(read_pixels(tmp_path / "turned.dng"), expected)
    header = read_header(tmp_path / "turned.dng")
    assert (header.height, header.width, header.orientation) == (*expected.shape[:2], orientation)


def test_what_takes_from_a_saturated_pixel_is_saturated(tmp_path):
    mosaic = np.full((ROWS, COLS), 6000, np.uint16)
    mosaic[8, 8] = WHITE + 200  # red
    scene = make_scene(8, 3)
    folder = write_capture(tmp_path / "cap", scene)
    write_dng(folder / "a.dng", mosaic)
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [COLS, ROWS]}, mask=None)
    for index in range(3):
        write_dng(folder / f"{index}.dng", mosaic)
        edit_frame(folder, index, image=f"{index}.dng")
    capture = Capture.open(folder)
    saturated = Correction.of(capture, full_scale=True).apply(capture.manifest.frames[0]).saturated
    expected = np.zeros((ROWS, COLS), bool)
    expected[7:10, 7:10] = True  # all whose red is a mean with it
    np.testing.assert_array_equal(saturated, expected)


def test_other_mosaics_take_the_colours_around_them():
    """X-Trans repeats after six pixels; an even surface is even in all colours, and own colours stay."""
    x_trans = np.array([list(map(int, row)) for row in ("121101", "010212", "101121", "121101", "212010", "101121")])
    colour = np.tile(x_trans, (4, 4)).astype(np.uint8)
    even = np.array([0.2, 0.5, 0.3], np.float32)
    np.testing.assert_allclose(camera_raw.demosaic(even[colour], colour), np.broadcast_to(even, (24, 24, 3)), atol=1e-6)  # float32 sums
    mosaic = RNG.random((24, 24)).astype(np.float32)
    own = np.take_along_axis(camera_raw.demosaic(mosaic, colour), colour[..., None].astype(int), axis=2)[..., 0]
    np.testing.assert_array_equal(own, mosaic)


def test_noise_around_black_is_kept_and_not_refused(tmp_path):
    """Covered lenses give half of their values below black; a capture takes them."""
    rows, cols = 600, 800
    place = 2 * (np.arange(rows)[:, None] % 2) + np.arange(cols) % 2
    levels = np.array(BLACK)[place]
    mosaic = np.rint(levels + 6 * RNG.normal(size=(rows, cols)))
    mosaic[200:400, 300:500] += 8000
    mosaic[500, 600] = 0  # a dead pixel
    folder = write_capture(tmp_path / "cap", make_scene(8, 3))
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [cols, rows]}, mask=None)
    for index in range(3):
        write_dng(folder / f"{index}.dng", mosaic.astype(np.uint16))
        edit_frame(folder, index, image=f"{index}.dng")
    values = Capture.open(folder).recorded("0.dng")
    dark = values[:180]
    assert 0.4 < (dark < 0).mean() < 0.6
    assert abs(dark.mean()) < 1e-5  # 6 counts of 14480 over 400 000 values; in place of 1.7e-4 if they were set to 0
    write_dng(folder / "0.dng", (mosaic - 60).clip(0).astype(np.uint16))  # as with a black level that is wrong
    with pytest.raises(ImageError, match=r"0\.dng: \d+ pixels are negative"):
        Capture.open(folder).recorded("0.dng")


def test_files_that_are_none_are_one_sentence(tmp_path, monkeypatch):
    write_dng(tmp_path / "a.dng", np.full((ROWS, COLS), 3000, np.uint16))
    data = (tmp_path / "a.dng").read_bytes()
    for length in (0, 100, 400, len(data) - 300):
        (tmp_path / "cut.nef").write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"cut\.nef: is no camera raw file that LibRaw reads, or it is"):
            read_pixels(tmp_path / "cut.nef")
    write_dng(tmp_path / "levels.dng", np.full((ROWS, COLS), 3000, np.uint16), white=500)
    with pytest.raises(ImageError, match="its white level 500 is not above its black level 5"):
        read_pixels(tmp_path / "levels.dng")
    monkeypatch.setattr(camera_raw, "find_spec", lambda name: None)
    with pytest.raises(ImageError, match=r"a\.dng: camera raw files are read with the extra raw: pip"):
        read_header(tmp_path / "a.dng")


def test_a_capture_of_raw_files_has_a_linear_colour_space(tmp_path):
    folder = write_capture(tmp_path / "cap", make_scene(8, 3))
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [COLS, ROWS]}, mask=None, color_space="srgb_texture")
    for index in range(3):
        write_dng(folder / f"{index}.dng", np.full((ROWS, COLS), 3000, np.uint16))
        edit_frame(folder, index, image=f"{index}.dng")
    with pytest.raises(ManifestError, match="color_space: srgb_texture is encoded for displays, and"):
        Capture.open(folder)


def test_imports_take_raw_as_linear_and_ask_which_of_two_recordings(tmp_path):
    for index in range(3):
        write_dng(tmp_path / f"IMG_{index}.DNG", np.full((ROWS, COLS), 3000, np.uint16))
        write_image(tmp_path / f"IMG_{index}.JPG", np.full((ROWS, COLS, 3), 90, np.uint8))
    with pytest.raises(ManifestError, match=r"IMG_0\.DNG and IMG_0\.JPG are one photograph: choose which"):
        import_photos(tmp_path, tmp_path)
    import_photos(tmp_path, tmp_path, selection=Selection(images="*.DNG"))
    capture = Capture.open(tmp_path)
    assert capture.manifest.color_space == "lin_rec709_scene"
    assert [frame.image for frame in capture.manifest.frames] == ["IMG_0.DNG", "IMG_1.DNG", "IMG_2.DNG"]
