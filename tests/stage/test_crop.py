"""A part of every image of a capture: readings, masks, corrections and rays are those of the whole at the same pixels."""

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError
from stage.pixels import Crop, PixelChoices
from stage.stack.correction import Correction
from stage.stack.ingest import open_stack
from stage.tof.raw_frames import read_correlations, read_histograms
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr, write_image, write_manifest

SCENE = make_scene(size=16, lights=4)
CROP = Crop(3, 5, 9, 7)
PART = PixelChoices(crop=CROP)
INSIDE = (slice(5, 12), slice(3, 12))
RNG = np.random.default_rng(3)


@pytest.mark.parametrize("given", [
    {"projection": "orthographic", "resolution": [16, 16], "pixel_size_m": 0.01},
    {"projection": "perspective", "resolution": [16, 16], "focal_px": [20, 21], "principal_px": [7.5, 8.25],
     "distortion": {"model": "brown_conrady", "k": [0.1, 0, 0]}},
], ids=["orthographic", "perspective"])
def test_rays_stay_where_they_are(given):
    camera = Camera.model_validate(given)
    part = camera.cropped(CROP)
    assert part.resolution == (9, 7)
    for whole, inside in zip(camera.plane_coordinates(), part.plane_coordinates(), strict=True):
        np.testing.assert_allclose(inside, whole[INSIDE], atol=1e-12)


def test_readings_masks_and_corrections_are_those_of_the_whole(tmp_path):
    write_capture(tmp_path, SCENE)
    write_exr(tmp_path / "dark.exr", RNG.random((16, 16, 3)) * 0.01)
    write_exr(tmp_path / "flat.exr", 0.5 + RNG.random((16, 16, 3)))
    edit_manifest(tmp_path, dark="dark.exr", flat="flat.exr", saturation=0.15)
    whole, part = Capture.open(tmp_path), Capture.open(tmp_path, PART)
    assert part.camera.resolution == (9, 7) and part.image_resolution == (16, 16)
    np.testing.assert_array_equal(part.mask(), whole.mask()[INSIDE])
    np.testing.assert_array_equal(part.mask_values(), whole.mask_values()[INSIDE])
    for frame in whole.sources():
        theirs, ours = (Correction.of(capture).apply(frame) for capture in (whole, part))
        np.testing.assert_array_equal(ours.pixels, theirs.pixels[INSIDE])  # the flat field is scaled over the whole mask
        np.testing.assert_array_equal(ours.saturated, theirs.saturated[INSIDE])


def test_a_part_has_a_stack_of_its_own(tmp_path):
    write_capture(tmp_path, SCENE)
    whole = open_stack(Capture.open(tmp_path))
    keys = {whole.key}
    for crop in (CROP, CROP._replace(x=4)):
        part = open_stack(Capture.open(tmp_path, PixelChoices(crop=crop)))
        keys.add(part.key)
        radiance, _ = part.pick_radiance(np.arange(63))
        inside = SCENE.images[:, crop.y : crop.y + 7, crop.x : crop.x + 9].reshape(4, 63, 3)
        np.testing.assert_allclose(radiance, inside, rtol=2.0**-11, atol=1e-6)  # half
    assert len(keys) == 3


@pytest.mark.parametrize(("crop", "words"), [
    (Crop(8, 0, 9, 4), "8,0,9,4: leads out of the images of .*, which are 16x16"),
    (Crop(0, 16, 1, 1), r"--crop 0,16,1,1: leads out"),
])
def test_a_part_outside_the_images_is_named(tmp_path, crop, words):
    write_capture(tmp_path, SCENE)
    with pytest.raises(ManifestError, match=words):
        Capture.open(tmp_path, PixelChoices(crop=crop))


def test_a_part_without_the_object_and_a_mask_of_another_size_are_named(tmp_path):
    write_capture(tmp_path, SCENE)
    with pytest.raises(ImageError, match=r"mask\.png: the mask is empty in --crop 0,0,2,2"):
        Capture.open(tmp_path, PixelChoices(crop=Crop(0, 0, 2, 2))).mask()
    write_image(tmp_path / "mask.png", np.full((7, 9), 255, np.uint8))  # of the part, where that of the whole is expected
    with pytest.raises(ImageError, match=r"mask\.png: is 9x7, camera\.resolution says 16x16"):
        Capture.open(tmp_path, PART)


def test_arrays_of_time_of_flight(tmp_path):
    counts = RNG.integers(1, 50, (16, 16, 8)).astype(np.float32)
    np.save(tmp_path / "h.npy", counts)
    camera = {"projection": "perspective", "resolution": [16, 16], "focal_px": [20, 20]}
    write_manifest(tmp_path, {"schema": "relit.capture/1", "name": "room", "camera": camera, "frames": [
        {"image": "h.npy", "tof": {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0}}]})
    np.testing.assert_array_equal(read_histograms(Capture.open(tmp_path, PART)).counts.reshape(7, 9, 8), counts[INSIDE])
    phases = RNG.normal(size=(4, 16, 16)).astype(np.float32)
    for index, phase in enumerate(phases):
        np.save(tmp_path / f"{index}.npy", phase)
    write_manifest(tmp_path, {"schema": "relit.capture/1", "name": "room", "camera": camera, "frames": [
        {"image": f"{index}.npy", "tof": {"type": "cw", "modulation_hz": 3e7, "reference_phase_rad": index * np.pi / 2}}
        for index in range(4)]})
    np.testing.assert_array_equal(read_correlations(Capture.open(tmp_path, PART)).images.reshape(4, 7, 9), phases[:, *INSIDE])
