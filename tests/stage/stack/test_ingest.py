"""Ingest: the layout of the cache, when it is rebuilt, and that it is whole or not there."""

import os

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ManifestError, StorageError
from stage.stack import stack
from stage.stack.ingest import Ingest, open_stack
from tests.scenes.captures import edit_frame, edit_manifest, files_in, make_scene, write_capture, write_exr, write_image

SCENE = make_scene(size=9, lights=5)
PIXELS, LIGHTS = 81, 5


def cache_files(folder):
    return {name for name in files_in(folder) if name.startswith(".relit/")}


def key_of(folder):
    return open_stack(Capture.open(folder)).key


def test_layout_is_channel_light_pixel_with_zero_padding(tmp_path):
    """Every scale is a power of two by which an image fills half; a band is a read-only part of the file."""
    found = open_stack(Capture.open(write_capture(tmp_path, SCENE)))
    values = np.load(tmp_path / ".relit" / f"stack-{found.key}.npy")
    assert values.shape == found.shape == (3, 8, 128) and values.dtype == np.float16
    assert (found.light_count, found.pixel_count) == (LIGHTS, PIXELS)
    assert not values[:, LIGHTS:].any() and not values[:, :, PIXELS:].any()
    assert not found.scale[LIGHTS:].any()
    stored = values[:, :LIGHTS, :PIXELS].astype(np.float64) * found.scale[:LIGHTS, None]
    truth = SCENE.images.reshape(LIGHTS, PIXELS, 3).transpose(2, 0, 1)
    # half rounding: half a unit of 2^-10
    assert np.allclose(stored, truth, rtol=2**-11, atol=0)
    assert found.frames == tuple(f"{i:03d}.exr" for i in range(LIGHTS))
    assert (np.frexp(found.scale[:LIGHTS])[0] == 0.5).all()
    peaks = np.abs(values).max(axis=(0, 2))[:LIGHTS]
    assert ((peaks >= 2**14) & (peaks <= 2**15)).all()
    part = found.band(64, 128)
    assert np.array_equal(part, values[:, :, 64:]) and not part.flags.writeable


def test_saturation_bits(tmp_path):
    scene = make_scene(size=9, lights=10)
    write_capture(tmp_path, scene, saturation=50.0)
    wanted = np.zeros((10, 81), bool)
    for light, pixel, channel in ((0, 0, 0), (3, 17, 1), (7, 17, 2), (8, 80, 0), (9, 80, 1)):
        scene.images[light].reshape(81, 3)[pixel, channel] = 50.0
        wanted[light, pixel] = True
        write_exr(tmp_path / f"{light:03d}.exr", scene.images[light])
    found = open_stack(Capture.open(tmp_path))
    bits = found.saturated(0, 128)
    assert bits.shape == (2, 128) and bits.dtype == np.uint8
    unpacked = np.unpackbits(bits, axis=0, bitorder="little").reshape(16, 128)
    assert np.array_equal(unpacked[:10, :81].astype(bool), wanted)
    assert not unpacked[10:].any() and not unpacked[:, 81:].any()
    assert np.array_equal(found.saturated(64, 128), bits[:, 64:])


def test_without_saturated_readings_there_is_no_file_and_no_bit(tmp_path):
    found = open_stack(Capture.open(write_capture(tmp_path, SCENE, saturation=50.0)))
    assert not found.saturated(0, 64).any()
    assert not any("saturated" in name for name in cache_files(tmp_path))


@pytest.mark.parametrize("bytes_per_pixel", [0, 4, 1000])
@pytest.mark.parametrize("pixels", [1, 63, 64, 65, 4096, 5000])
def test_bands_cover_every_pixel_once_in_multiples_of_64(tmp_path, monkeypatch, pixels, bytes_per_pixel):
    monkeypatch.setattr(stack, "BAND_BYTES", 1 << 16)
    found = stack.Stack(tmp_path, "k", ("a",) * 5, np.ones(8, np.float32), pixels)
    bands = list(found.bands(bytes_per_pixel))
    assert bands[0][0] == 0 and bands[-1][1] == found.shape[2] >= pixels
    assert [stop for _, stop in bands[:-1]] == [start for start, _ in bands[1:]]
    assert all((stop - start) % 64 == 0 and stop > start for start, stop in bands)
    smallest = 64 * (48 + bytes_per_pixel)
    assert all((stop - start) * (48 + bytes_per_pixel) <= max(1 << 16, smallest) for start, stop in bands)


def test_the_second_opening_decodes_nothing(tmp_path):
    write_capture(tmp_path, SCENE)
    steps: list[tuple[int, int]] = []
    first = open_stack(Capture.open(tmp_path), progress=lambda done, total: steps.append((done, total)))
    assert steps == [(i + 1, LIGHTS) for i in range(LIGHTS)]
    again = open_stack(Capture.open(tmp_path), progress=lambda done, total: steps.append((done, total)))
    assert steps[LIGHTS:] == [(LIGHTS, LIGHTS)]
    assert again.key == first.key and np.array_equal(again.scale, first.scale) and again.frames == first.frames


def change_pixel(folder):
    image = SCENE.images[2].copy()
    image[4, 4, 1] += 0.001
    write_exr(folder / "002.exr", image)


def change_dark(folder):
    write_exr(folder / "dark.exr", np.full((9, 9, 3), 0.002))


def change_mask(folder):
    write_image(folder / "mask.png", np.full((9, 9), 255, np.uint8))


def swap_frames(folder):
    edit_manifest(folder, frames=lambda frames: [frames[1], frames[0], *frames[2:]])


@pytest.mark.parametrize("change", [
    change_pixel,
    change_dark,
    change_mask,  # the flat is scaled over it
    swap_frames,
    lambda folder: edit_frame(folder, 2, exposure_s=2.0),
    lambda folder: edit_frame(folder, 4, light={"type": "off"}),
    lambda folder: edit_manifest(folder, dark=None),
    lambda folder: edit_manifest(folder, flat=None),
    lambda folder: edit_manifest(folder, color_space="lin_ap1_scene"),
    lambda folder: edit_manifest(folder, saturation=0.3),
    lambda folder: edit_manifest(folder, color_matrix=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
    lambda folder: edit_frame(folder, 1, color_matrix=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
], ids=["pixel", "dark", "mask", "order", "exposure", "off", "no dark", "no flat",
        "colour space", "saturation", "colours", "colours of a frame"])
def test_it_is_rebuilt_when_an_input_changes(tmp_path, change):
    prepare(tmp_path)
    before = open_stack(Capture.open(tmp_path))
    change(tmp_path)
    after = open_stack(Capture.open(tmp_path))
    assert after.key != before.key
    # the old one is gone
    assert {name for name in cache_files(tmp_path) if before.key in name} == set()
    assert {f".relit/stack-{after.key}.npy", f".relit/stack-{after.key}.json", ".relit/files.json"} <= cache_files(tmp_path)


def prepare(folder):
    write_capture(folder, SCENE, dark="dark.exr", flat="flat.exr")
    for index in range(LIGHTS):
        edit_frame(folder, index, exposure_s=1.0)
    write_exr(folder / "004.exr", np.full((9, 9, 3), 0.002))  # may be `off`
    write_exr(folder / "dark.exr", np.full((9, 9, 3), 0.001))
    write_exr(folder / "flat.exr", 1 + np.random.default_rng(2).random((9, 9, 3)))


def touch(folder):
    for path in folder.glob("*.exr"):
        os.utime(path, ns=(10**18, 10**18))


def rewrite(folder):
    (folder / "001.exr").write_bytes((folder / "001.exr").read_bytes())


@pytest.mark.parametrize("change", [
    touch,
    rewrite,
    lambda folder: edit_frame(folder, 1, light={"type": "distant", "direction": [0.3, 0, 1], "irradiance": [2, 2, 2]}),
    lambda folder: edit_manifest(folder, name="other"),
], ids=["touched", "rewritten", "light", "name"])
def test_it_is_kept_when_no_input_changes(tmp_path, change):
    prepare(tmp_path)
    key = key_of(tmp_path)
    stamp = (tmp_path / ".relit" / f"stack-{key}.npy").stat().st_mtime_ns
    change(tmp_path)
    assert key_of(tmp_path) == key
    assert (tmp_path / ".relit" / f"stack-{key}.npy").stat().st_mtime_ns == stamp


def test_the_cache_may_lie_elsewhere(tmp_path):
    write_capture(tmp_path / "capture", SCENE)
    open_stack(Capture.open(tmp_path / "capture"), cache=tmp_path / "fast" / "disk")
    assert not cache_files(tmp_path / "capture")
    assert any(name.endswith(".npy") for name in files_in(tmp_path / "fast" / "disk"))


@pytest.mark.parametrize("at", [1, 3, LIGHTS])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_no_stack_and_no_temporary(tmp_path, at, error):
    write_capture(tmp_path, SCENE)

    def stop(done: int, total: int) -> None:
        if done == at:
            raise error

    with pytest.raises(error):
        open_stack(Capture.open(tmp_path), progress=stop)
    assert cache_files(tmp_path) == set()
    assert open_stack(Capture.open(tmp_path)).light_count == LIGHTS  # and the next run is none the worse


def test_a_failure_after_the_values_takes_them_away_too(tmp_path, monkeypatch):
    write_capture(tmp_path, SCENE)

    def full(path, text):
        raise StorageError(f"cannot write {path}: no space left on device")

    monkeypatch.setattr(stack, "write_text", full)
    with pytest.raises(StorageError, match="no space left"):
        open_stack(Capture.open(tmp_path))
    assert cache_files(tmp_path) == set()


def test_no_frame_that_a_light_lit(tmp_path):
    write_capture(tmp_path, make_scene(size=4, lights=1))
    edit_frame(tmp_path, 0, light={"type": "off"})
    with pytest.raises(ManifestError, match="none is lit by a distant, point, extended or gradient light"):
        open_stack(Capture.open(tmp_path))
    assert cache_files(tmp_path) == set()


@pytest.mark.parametrize("length", [0, 60, -2])
def test_a_cache_that_was_cut_short_is_named(tmp_path, length):
    write_capture(tmp_path, SCENE)
    found = open_stack(Capture.open(tmp_path))
    path = tmp_path / ".relit" / f"stack-{found.key}.npy"
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(StorageError, match=rf"{path.name}: the cache is damaged: delete it and run again"):
        found.band(0, 64)


def test_a_cache_folder_that_cannot_be_made(tmp_path):
    write_capture(tmp_path, SCENE)
    (tmp_path / ".relit").write_text("in the way")
    with pytest.raises(StorageError, match=r"cannot make the stack cache .*--cache names another folder.*"):
        open_stack(Capture.open(tmp_path))
    assert cache_files(tmp_path) == set()


def test_the_key_is_known_before_anything_is_built(tmp_path):
    write_capture(tmp_path)
    before = files_in(tmp_path)
    hashed = Ingest.of(Capture.open(tmp_path))
    assert files_in(tmp_path) == before
    assert hashed.stack().key == hashed.key == open_stack(Capture.open(tmp_path)).key
