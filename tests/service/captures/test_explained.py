"""relit info looks at the encoding, the brightness and the order of the lights, as tests/service/solve/lights/test_diagnosis.py does."""

import numpy as np
import pytest

from service.captures.info import inspect
from service.requests.captures import InfoRequest
from tests.scenes.captures import manifest_of, write_exr, write_image, write_manifest
from tests.scenes.ellipsoid import ellipsoid

SCENE = ellipsoid(count=12)
EXPOSURE = 0.25
SCALED = np.maximum(SCENE.images, 0) / SCENE.images.max()


def srgb(linear):
    return np.where(linear < 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def findings(folder, recorded, **changes):
    """What is found in a capture of these values, [lights, rows, cols, 3] from 0 to 1, in 16 bits."""
    frames = manifest_of(SCENE)["frames"]
    for index, (frame, values) in enumerate(zip(frames, recorded, strict=True)):
        frame |= {"image": f"{index}.png", "exposure_s": EXPOSURE}
        write_image(folder / frame["image"], np.round(values * 65535).astype(np.uint16))
    write_image(folder / "mask.png", (SCENE.mask * 255).astype(np.uint8))
    write_manifest(folder, {**manifest_of(SCENE), "frames": frames, **changes})
    found = inspect(InfoRequest(capture=folder))
    assert found.faults == []
    return found.findings


@pytest.mark.parametrize(("encode", "declared"), [(lambda values: values, "lin_rec709_scene"), (srgb, "srgb_texture"),
                                                  (lambda values: values ** (1 / 2.2), "g22_rec709_scene")])
def test_a_right_manifest_has_no_finding(tmp_path, encode, declared):
    assert findings(tmp_path, encode(SCALED), color_space=declared) == []


@pytest.mark.parametrize("encode", [srgb, lambda values: values ** (1 / 2.2)], ids=["sRGB", "power"])
def test_encoded_images_that_are_declared_linear_are_named(tmp_path, encode):
    """The curves of sRGB and of a power of 2.2 differ by less than these pixels tell."""
    (finding,) = findings(tmp_path, encode(SCALED))
    assert finding.startswith("color_space: the images look display-encoded, but lin_rec709")
    assert finding.endswith(("declare srgb_texture if they are", "declare g22_rec709_scene if they are"))
def test_other_suspicions_are_named_and_the_command_prints_them_and_ends_well(relit, tmp_path):
    (finding,) = findings(tmp_path, SCALED, color_space="srgb_texture")
    assert "the images look linear, but srgb_texture is declared" in finding
    (finding,) = findings(tmp_path, SCALED[::-1])
    assert finding.startswith("frames[].light: the order looks reversed")
    assert "\nfinding      frames[].light: the order looks reversed" in relit("info", tmp_path).well()


def test_a_dark_image_is_taken_off_first(tmp_path):
    """A pedestal that hides the shadows, in the images and in the dark image."""
    write_exr(tmp_path / "dark.exr", np.full((*SCENE.mask.shape, 3), 0.2))
    assert findings(tmp_path, 0.2 + 0.8 * SCALED, dark="dark.exr") == []
