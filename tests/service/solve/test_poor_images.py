"""Captures at the edge of what can be solved: images of one or two rows, and images that determine no lights. No traceback, no file."""

import numpy as np
import pytest

from tests.marks import first_short
from tests.scenes.captures import Scene, angles_degrees, distant, render, ring, write_capture, write_lit

RNG = np.random.default_rng(41)


def waves(rows: int, cols: int, lights: int) -> Scene:
    y, x = np.mgrid[:rows, :cols]
    normal = np.stack([0.3 * np.sin(x / 7.0), 0.3 * np.cos(y / 5.0), np.ones((rows, cols))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.broadcast_to((0.5 + 0.2 * np.sin(x / 9.0))[..., None], (rows, cols, 3))
    directions, irradiance = ring(lights), np.ones((lights, 3))
    return Scene(normal, albedo, np.ones((rows, cols), bool), directions, irradiance, render(normal, albedo, directions, irradiance))


@first_short("shape", [(1, 37), (37, 1), (2, 40), (40, 2)])
@pytest.mark.parametrize("method", ["lambert", "robust"])
def test_thin_images_are_solved(relit, tmp_path, shape, method):
    scene = waves(*shape, 9)
    write_capture(tmp_path, scene)
    maps, *_ = relit.solve(tmp_path, "--method", method)
    assert maps.mask.all() and angles_degrees(maps.normal, scene.normal).max() < 0.1  # half rounding of nine readings


@first_short("method", ["robust", "lambert", "svbrdf"])
def test_a_lamp_in_the_picture(relit, tmp_path, method):
    """Its albedo is beyond half floats: the maps are readable, and the others are right to the half rounding of nine readings."""
    scene = waves(20, 30, 9)
    scene.images[:, 10, 12] = 60000 * scene.directions[:, 2:]
    write_capture(tmp_path, scene)
    maps, *_ = relit.solve(tmp_path, "--method", method)
    assert np.isfinite(maps.diffuse_albedo).all() and maps.diffuse_albedo[10, 12].min() > 6e4
    others = scene.mask.copy()
    others[10, 12] = False
    assert np.median(angles_degrees(maps.normal, scene.normal)[others]) < 0.1


def test_readings_that_are_clipped_below_full_scale_are_said(relit, tmp_path):
    """Twelve bits in files of sixteen, of which a tenth is clipped."""
    scene = waves(20, 30, 9)
    images = np.minimum(scene.images / np.quantile(scene.images, 0.9), 1) * 4095 / 65535
    folder = write_lit(tmp_path, images, [distant(light, 1.0) for light in scene.directions], names="{:03d}.png",
                       camera={"projection": "orthographic", "resolution": [30, 20]}, irradiance_scale="relative",
                       color_space="lin_rec709_scene")
    _, report, _ = relit.solve(folder, "--method", "robust")
    assert any("4095 of 65535" in sentence for sentence in report["warnings"])


@pytest.mark.parametrize("images", ["alike", "mostly dark"])
def test_images_that_determine_no_lights(relit, tmp_path, images):
    scene = waves(40, 40, 9)
    shown = np.repeat(scene.images[:1], 9, axis=0) + RNG.normal(0, 1e-3, scene.images.shape)
    if images == "mostly dark":
        shown = scene.images.copy()
        shown[1] = 0
        shown[1, 5:12, 8:20] = 0.1
    write_capture(tmp_path, scene._replace(images=np.maximum(shown, 0)))
    outcome = relit("solve", tmp_path, "--lights", "unknown", "--out", tmp_path / "out")
    assert outcome.code == (1 if outcome.out else 2)  # no pixel is solved, or no lights are found; a traceback would end the test
    assert outcome.out or ("--lights unknown" in outcome.err and not (tmp_path / "out").exists())


@first_short(("width", "said"), [(1, True), (2, True), (5, False)])
def test_wires_are_said(relit, tmp_path, width, said):
    """A bar that leaves the object, whose pixels mix with what lies behind it where it is thin."""
    scene = waves(60, 80, 7)
    y, x = np.mgrid[:60, :80]
    mask = (np.hypot(y - 30, x - 25) < 20) | ((x >= 30) & (y >= 30) & (y < 30 + width))
    write_capture(tmp_path, scene._replace(mask=mask, images=scene.images * mask[..., None]))
    out = relit.done("solve", tmp_path, "--method", "robust", "--out", tmp_path / "out").out
    assert ("such as wires" in out) == said
