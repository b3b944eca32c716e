"""relit relight with clipped readings: taken from another exposure of the light, or said, or from the model where it is brighter."""

import json
import re

import numpy as np
import pytest

from stage.formats import exr
from tests.scenes.captures import rgb, write_exr, write_image
from tests.scenes.glossy import dome, write_dome, write_maps

SURFACE = dome()
EVEN = np.full((16, 32, 3), 0.3)


def clip(folder, level, exposures=(1.0,)):
    """Rewrite a capture as a camera that clips at a level records it, at these exposures of every light."""
    data = json.loads((folder / "capture.json").read_text())
    frames = []
    for frame in data["frames"]:
        image = rgb(folder / frame["image"])
        for index, exposure in enumerate(exposures):
            name = f"c{index}_{frame['image']}"
            write_exr(folder / name, np.minimum(image * exposure, level))
            frames.append({**frame, "image": name, "exposure_s": exposure})
    (folder / "capture.json").write_text(json.dumps({**data, "frames": frames, "saturation": level}))


@pytest.fixture
def capture(tmp_path):
    """The dome, the even sky, and the frame without clipping."""
    write_dome(tmp_path / "cap", SURFACE)
    write_exr(tmp_path / "sky.exr", EVEN)
    return tmp_path


def relight(relit, folder, out, *options):
    outcome = relit.done("relight", folder / "cap", "--environment", folder / "sky.exr", "--out", out / "f.#.exr", *options)
    return rgb(out / "f.1.exr"), outcome.out


@pytest.mark.long
def test_bracketed_frames_give_the_frame_without_clipping(relit, capture):
    """The longest exposure comes first and is clipped at most pixels; to half rounding of images, sums and frames."""
    truth, _ = relight(relit, capture, capture / "a")
    guide = write_maps(capture / "maps", SURFACE)
    guided, _ = relight(relit, capture, capture / "g", "--maps", guide)
    clip(capture / "cap", 0.15, exposures=(4.0, 1.0, 0.25))
    for name, expected, options in (("b", truth, ()), ("c", guided, ("--maps", guide))):
        frame, out = relight(relit, capture, capture / name, *options)
        assert SURFACE.off(frame, expected) < 2e-3 and "warning" not in out


def test_what_is_clipped_at_every_exposure_is_said(relit, capture):
    """Red is clipped, where it is brighter than the level; by the sum of the images."""
    level = 0.25
    images = np.stack([rgb(path) for path in sorted((capture / "cap").glob("0*.exr"))])
    clip(capture / "cap", level)
    _, out = relight(relit, capture, capture / "b")
    warning, = (line for line in out.splitlines() if line.startswith("warning"))
    red, green, blue, pixels = (float(value) for value in re.findall(r"([\d.]+) %", warning))
    inside = images[:, SURFACE.mask]
    recorded = np.minimum(inside, level)
    # all lights of one strength, so that an even sky weighs them by their cells, about alike
    expected = (recorded * (inside >= level)).sum(axis=(0, 1)) / recorded.sum(axis=(0, 1)) * 100
    np.testing.assert_allclose([red, green, blue], expected, rtol=0.15, atol=0.1)
    assert red > green > blue
    assert pixels == pytest.approx(100 * (inside >= level).any(axis=(0, 2)).mean(), rel=0.05)
    assert "exposure_s" in warning and "too dark" in warning
    report = capture / "r.json"
    relight(relit, capture, capture / "b", "--overwrite", "--report", report)
    assert [warning.removeprefix("warning  ")] == json.loads(report.read_text())["warnings"]


@pytest.mark.long
def test_a_model_that_is_brighter_fills_clipped_readings_in(relit, capture):
    """With true maps, but for the lobe that is widened as guided lobes are."""
    truth, _ = relight(relit, capture, capture / "a", "--weights", "smooth")
    clip(capture / "cap", 0.25)
    plain, _ = relight(relit, capture, capture / "b", "--weights", "smooth")
    guided, out = relight(relit, capture, capture / "c", "--maps", write_maps(capture / "maps", SURFACE))
    assert SURFACE.off(guided, truth) < 0.4 * SURFACE.off(plain, truth)
    assert "taken from the model of the maps" in out


def test_integers_at_full_scale_are_clipped_without_a_word_in_the_manifest(relit, capture):
    data = json.loads((capture / "cap" / "capture.json").read_text())
    for frame in data["frames"]:
        image = rgb(capture / "cap" / frame["image"])
        frame["image"] = frame["image"].replace(".exr", ".png")
        write_image(capture / "cap" / frame["image"], np.round(np.minimum(image / 0.2, 1) * 65535).astype(np.uint16))
    (capture / "cap" / "capture.json").write_text(json.dumps(data))
    _, out = relight(relit, capture, capture / "b")
    assert "is from readings that are clipped" in out


@pytest.mark.long
def test_basis_of_brackets_holds_whole_readings(relit, capture):
    """Each of three frames of a light gives the same, merged image: the coefficients are those of the images without clipping."""
    clip(capture / "cap", 0.15, exposures=(4.0, 1.0, 0.25))
    relit.done("basis", capture / "cap", "--out", capture / "b.exr", "--count", "48")
    channels, _ = exr.read(capture / "b.exr")
    facts = json.loads((capture / "b.exr.json").read_text())
    matrix = np.array(facts["matrix"])  # [3, K, frames]
    layers = np.stack([[channels[f"basis.{k:03d}.{c}"] for k in range(matrix.shape[1])] for c in "RGB"]).astype(float)
    brightest = np.einsum("ck,ckyx->yxc", matrix[:, :, 0], layers)
    image = rgb(capture / "cap" / "000.exr")
    assert SURFACE.off(brightest, image) < 0.01 or image.max() < 0.01


@pytest.mark.long
def test_solving_brackets_is_solving_whole_frames(relit, capture):
    """Each light counts once, with its merged reading; to the half rounding of the images."""
    def solve(name):
        outcome = relit("solve", capture / "cap", "--method", "lambert", "--out", capture / name)
        assert outcome.code == 0 and "suspect" not in outcome.out
        channels, _ = exr.read(capture / name / "maps.exr")
        return np.stack([channels[f"normal.{axis}"] for axis in "XYZ"], axis=-1)[SURFACE.mask]

    whole = solve("a")
    clip(capture / "cap", 0.15, exposures=(4.0, 1.0, 0.25))
    assert np.abs(solve("b") - whole).max() < 2e-3
