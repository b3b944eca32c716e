"""What the readings of a capture show and its manifest does not say: clipping below full scale, a mask of all else."""


import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.stack.ingest import open_stack
from stage.stack.peaks import Peaks
from stage.stack.readings import said_by_readings
from tests.scenes.captures import make_scene, manifest_of, write_image, write_manifest

SCENE = make_scene(64, 12)
SHINING = SCENE.images / SCENE.images.max() + 0.6 * np.einsum(
    "rcx,lx->lrc", SCENE.normal, (half := SCENE.directions + (0, 0, 1)) / np.linalg.norm(half, axis=1, keepdims=True))[..., None] ** 60


def capture(folder, images, *, mask=SCENE.mask, dtype=np.uint16, full=65535, **changes):
    """The scene with other images, whose full scale is at 1."""
    codes = images * full if np.issubdtype(dtype, np.floating) else np.round(np.clip(images, 0, 1) * full)
    for index, image in enumerate(codes):
        write_image(folder / f"{index:03d}.tif", image.astype(dtype))
    write_image(folder / "mask.png", np.where(mask, 255, 0).astype(np.uint8))
    data = manifest_of(SCENE, **changes)
    for frame in data["frames"]:
        frame["image"] = frame["image"].replace(".exr", ".tif")
    write_manifest(folder, data)
    return Capture.open(folder)


def noisy(images, sigma=0.002):
    return images + np.random.default_rng(3).normal(0, sigma, images.shape)


@pytest.mark.parametrize("images", [0.6 * SHINING, 1.5 * SHINING, noisy(0.6 * SHINING), SCENE.images / SCENE.images.max()])
@pytest.mark.parametrize(("dtype", "full"), [(np.uint16, 65535), (np.uint8, 255), (np.float32, 1)])
def test_right_captures_are_not_accused(tmp_path, images, dtype, full):
    """Integers are clipped at their largest by themselves."""
    assert not said_by_readings(capture(tmp_path, images if full > 1 else np.maximum(images, 0), dtype=dtype, full=full))


@pytest.mark.parametrize(("dtype", "full", "level", "saturation"), [
    (np.uint16, 4095, "0.06249 (4095 of 65535)", 0.06248), (np.uint16, 65520, "0.9998 (65520 of 65535)", 0.99977),
    (np.float32, 1, "1, and none", 1)])
def test_clipping_below_full_scale_is_said_until_it_is_declared(tmp_path, dtype, full, level, saturation):
    """Twelve bits in files of sixteen, at their lower or upper end, and images that were clipped at 1 on their way."""
    images = np.minimum(1.2 * SHINING, 1)
    said, = said_by_readings(capture(tmp_path, images, dtype=dtype, full=full))
    assert said.startswith("saturation:") and level in said and said.endswith(f"give saturation {saturation:.5g}")
    assert not said_by_readings(capture(tmp_path, images, dtype=dtype, full=full, saturation=saturation))


def test_eight_bits_in_sixteen_are_said(tmp_path):
    said, = said_by_readings(capture(tmp_path, 1.2 * SHINING, full=255))
    assert said.startswith("frames[].image: the highest reading is 255 of 65535")


@pytest.mark.parametrize(("ground", "words"), [(0.0, "brighter"), (0.5, "no plane")])
def test_a_mask_of_the_background_is_said(tmp_path, ground, words):
    rows, cols = np.mgrid[:64, :64] - 31.5
    mask = np.hypot(rows, cols) < 26
    images = noisy(np.where(mask[..., None], 0.5 * SHINING, ground * SCENE.directions[:, 2, None, None, None]))
    said, = (said for said in said_by_readings(capture(tmp_path, images, mask=~mask)) if not said.startswith("frames"))
    assert said.startswith("mask:") and words in said
    assert not said_by_readings(capture(tmp_path, images, mask=mask))


def test_a_mask_in_alpha_is_said(tmp_path):
    found = capture(tmp_path, noisy(0.5 * SHINING))
    for colour, told in ((np.full_like(SCENE.mask, True), True), (SCENE.mask, False)):
        layers = [*[np.where(colour, 255, 0)] * 3, np.where(SCENE.mask, 255, 0)]
        write_image(tmp_path / "mask.png", np.stack(layers, axis=-1).astype(np.uint8))
        assert [said.startswith("mask: it is white everywhere") for said in said_by_readings(found)] == [True] * told


@pytest.fixture
def decoded(monkeypatch):
    """The images that are decoded for what is said."""
    names, recorded = [], Capture.recorded
    monkeypatch.setattr(Capture, "recorded", lambda self, name, **more: names.append(name) or recorded(self, name, **more))
    return names


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_stack_says_what_its_ingest_has_seen(tmp_path, decoded, dtype):
    """When it is made and from the cache, and no longer where another mask has other pixels."""
    found = capture(tmp_path, np.minimum(1.2 * SHINING, 1), dtype=dtype, full=4095 if dtype == np.uint16 else 1)
    wanted = said_by_readings(found)
    assert len(wanted) == 1
    for again in (False, True):
        decoded.clear()
        stack = open_stack(found)
        assert len(decoded) == (0 if again else 12)
        (peaks := Peaks(found)).recall(stack.peaks)
        decoded.clear()
        assert said_by_readings(found, peaks) == wanted and not decoded
    write_image(tmp_path / "mask.png", np.where(np.roll(SCENE.mask, 1, axis=1), 255, 0).astype(np.uint8))
    (peaks := Peaks(found)).recall(stack.peaks)
    assert not peaks.found


@pytest.mark.parametrize(("level", "count"), [(0.6, 6), (1.5, 1), (0.2, 12)])
def test_few_images_are_decoded_where_nothing_is_to_say(tmp_path, decoded, level, count):
    """One of full scale shows that nothing is clipped below it; all are looked at where none is above the range of fourteen bits."""
    assert not said_by_readings(capture(tmp_path, level * SHINING / SHINING.max())) and len(decoded) == count
