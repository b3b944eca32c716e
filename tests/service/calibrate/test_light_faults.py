"""What measured lights show that they should not, by balls traced in closed form: clipped readings, images of other lights, radii that are
not those of the balls."""

import numpy as np
import pytest

from tests.reference.balls import lambertian, mirror_of_far, mirror_of_near, render
from tests.scenes.captures import write_image
from tests.service.calibrate.test_calibrate import CIRCLE, DIRECTIONS, GEOMETRY, grey_images, lights_of, mirror_images, report_of, write

IRRADIANCE = 1 + np.arange(len(DIRECTIONS))
TOLD = [{"type": "distant", "direction": direction, "irradiance": [1, 1, 1]} for direction in DIRECTIONS.tolist()]


def grey(relit, folder, images, lights=TOLD, **changes):
    """The outcome of a grey ball, the irradiances that it gives, and the flags of its lights."""
    outcome = relit.done("calibrate", "grey-ball", write(folder, images, lights, **changes), "--ball", CIRCLE, "--albedo", "0.5")
    return outcome, np.array([light.irradiance[1] for light in lights_of(folder)]), [
        light["flags"] for light in report_of(folder, "grey-ball")["lights"]]


@pytest.mark.parametrize(("bits", "clip"), [(16, 0.5), (8, 1.0)])
def test_readings_that_are_clipped_do_not_count(relit, tmp_path, bits, clip):
    """At a level below that of the files, and at the largest integer: the manifest gives no saturation. Irradiances were up to 20 % low."""
    scale = 1 / max(image.max() for image in grey_images()) * (1 if bits == 16 else 1.7)
    images = [np.minimum(scale * image, clip) for image in grey_images()]
    kind = np.uint8 if bits == 8 else np.uint16
    written = [np.rint(image * np.iinfo(kind).max).astype(kind) for image in images]
    folder = tmp_path / "ball"
    capture = write(folder, images, TOLD)
    for frame, values in zip(sorted(capture.glob("*.exr")), written, strict=True):
        frame.unlink()
        write_image(frame.with_suffix(".png"), values)
    text = (capture / "capture.json").read_text()
    (capture / "capture.json").write_text(text.replace(".exr", ".png"))
    relit.done("calibrate", "grey-ball", capture, "--ball", CIRCLE, "--albedo", "0.5")
    found = np.array([light.irradiance[1] for light in lights_of(folder)])
    flags = [light["flags"] for light in report_of(folder, "grey-ball")["lights"]]
    assert np.abs(found / scale / IRRADIANCE - 1).max() < 0.006  # steps of eight bits
    assert any("clipped at" in flag for flag in flags[-1]) and flags[0] == []


def test_images_of_other_lights_are_named_by_their_shading(relit, tmp_path):
    swapped = [grey_images()[number] for number in (0, 2, 1, 3, 4)]
    outcome, _, flags = grey(relit, tmp_path / "swapped", swapped)
    assert "the shading of the ball says that the light stands up to 53° from" in outcome.out  # as far as both stand apart
    assert [bool(flag) for flag in flags] == [False, True, True, False, False]
    outcome, _, flags = grey(relit, tmp_path / "good", grey_images())
    assert not outcome.err and "shading" not in outcome.out and not any(flags)


def test_lights_side_by_side_whose_images_are_exchanged_are_named(relit, tmp_path):
    """5° apart, which is no more than the outline of the ball leaves open, but the shading fits all others ten times as well."""
    directions = np.array([[0.0, 0.1, 1.0], [0.6, 0.0, 1.0], [0.5, -0.06, 1.0], [-0.3, 0.5, 1.0], [-0.4, -0.4, 0.6]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    images = [render(lambertian(direction, albedo=0.5, irradiance=irradiance), **GEOMETRY)[0]
              for direction, irradiance in zip(directions, IRRADIANCE, strict=True)]
    lights = [{**light, "direction": direction} for light, direction in zip(TOLD, directions.tolist(), strict=True)]
    outcome, _, flags = grey(relit, tmp_path / "ball", [images[number] for number in (0, 2, 1, 3, 4)], lights)
    assert "the light stands up to 5° from" in outcome.out
    assert [bool(flag) for flag in flags] == [False, True, True, False, False]


def test_a_lamp_that_did_not_change_is_said(relit, tmp_path):
    """With noise of its own, so that it is no copy; frames of two exposures may show one lamp."""
    images = list(mirror_images())
    images[3] = images[1] + np.float32(1e-3) * np.random.default_rng(0).random(images[1].shape, dtype=np.float32)
    folder = write(tmp_path / "ball", images)
    outcome = relit.done("calibrate", "mirror-ball", folder, "--ball", CIRCLE)
    assert "the lamp stands at one place in" in outcome.out and outcome.out.count(" as ") == 1
    assert "at one place" not in relit.done("calibrate", "mirror-ball", write(tmp_path / "good", mirror_images()), "--ball", CIRCLE).out
    beside = DIRECTIONS[1] + [0.0, 0.11, 0.0]  # two discs of 3° that touch
    images[3] = render(mirror_of_far(beside / np.linalg.norm(beside), degrees=3), **GEOMETRY)[0]
    assert "at one place" not in relit.done("calibrate", "mirror-ball", write(tmp_path / "near", images), "--ball", CIRCLE).out


def test_soft_boxes_near_each_other_are_two(relit, tmp_path):
    """Two soft boxes of 30° stand 1.8° apart, as a box that is held by hand may; their spots spread by five times as much."""
    images = list(mirror_images())
    beside = DIRECTIONS[1] + [0.0, 0.033, 0.0]
    for number, way in ((1, DIRECTIONS[1]), (3, beside / np.linalg.norm(beside))):
        images[number] = render(mirror_of_far(way, degrees=15), **GEOMETRY)[0]
    assert "at one place" not in relit.done("calibrate", "mirror-ball", write(tmp_path / "ball", images), "--ball", CIRCLE).out


@pytest.mark.long
def test_radii_that_are_exchanged_are_said_and_held_by_sigma(relit, tmp_path):
    """Two balls stand before a perspective camera. Positions were off by up to 21 times what was stated."""
    camera = {"focal": 400.0, "width": 200, "height": 80}
    positions = np.array([[0.3, 0.25, -0.5], [-0.25, -0.2, -0.4], [0.1, 0.35, -0.45], [0.25, -0.2, -0.35]])
    balls = [(np.array([-0.12, 0.0, -1.0]), 0.07), (np.array([0.13, 0.01, -1.02]), 0.06)]
    renders = [[render(mirror_of_near(p, degrees=3), centre=c, radius=r, **camera) for c, r in balls] for p in positions]
    masks = [write_image(tmp_path / f"mask{i}.png", (255 * renders[0][i][1]).astype(np.uint8)) for i in (0, 1)]
    folder = write(tmp_path / "balls", [np.maximum(left[0], right[0]) for left, right in renders], camera={
        "projection": "perspective", "resolution": [200, 80], "focal_px": [400, 400]})

    def measured(*radii):
        words = [word for mask, radius in zip(masks, radii, strict=True) for word in ("--ball-mask", mask, "--ball-radius-m", radius)]
        outcome = relit.done("calibrate", "light-positions", folder, *words)
        lights = report_of(folder, "light-positions")["lights"]
        off = [np.linalg.norm(np.array(light["position_m"]) - at) for light, at in zip(lights, positions, strict=True)]
        return outcome.out, np.max(np.array(off) / [light["uncertainty_m"] for light in lights])

    said, ratio = measured(0.07, 0.06)
    assert "do not meet" not in said and ratio < 2
    said, ratio = measured(0.06, 0.07)
    assert "the reflections in the balls do not meet in 4 of 4 frames: check the radii" in said and ratio < 2
