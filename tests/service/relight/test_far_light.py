"""relit relight and shade under light from beyond the captured lights: never worse than the plain sum, and said."""

import numpy as np
import pytest

from tests.reference.sampling import lattice
from tests.scenes.captures import rgb, write_exr
from tests.scenes.glossy import ALBEDO, PIXEL_M, dome, lat_long, reflect, write_dome, write_maps
from tests.service.relight.test_clipping import relight

pytestmark = pytest.mark.long

SURFACE = dome(40)
LIGHTS = lattice(48, 45)
SUN_DEGREES = 80
"""Angle of the sun from the view axis: 35 degrees beyond the captured lights, which are 11 degrees apart."""


def sky(folder, degrees, rows=48):
    """A lat-long map with a sun this far from +z, towards +x and +y, over a dim sky; and the dome under it by the twin."""
    tilt = np.radians(degrees)
    middle = np.array([np.sin(tilt) * 0.8, np.sin(tilt) * 0.6, np.cos(tilt)])
    directions, solid_angle = lat_long(rows)
    values = np.where((directions @ middle > np.cos(np.radians(8.0)))[..., None], [60.0, 50.0, 40.0], 0.01)
    write_exr(folder / "sky.exr", values)
    truth = np.zeros((*SURFACE.mask.shape, 3))
    for row in range(rows):
        truth += np.einsum("rctk,tk->rck", reflect(SURFACE.normal[:, :, None], directions[row]), values[row] * solid_angle[row])
    return truth * SURFACE.mask[..., None]


def patchy():
    """[rows, cols, 3] an albedo that is between half and 1.6 times the true one, in patches some pixels wide."""
    rows, cols = np.indices(SURFACE.mask.shape)
    return (ALBEDO * (1.05 + 0.55 * np.sin(rows / 3.0) * np.cos(cols / 4.0))[..., None]).astype(np.float32)


def ripples() -> dict[str, np.ndarray]:
    """The normals and the height of another surface, of ripples a dozen pixels wide."""
    phase = np.broadcast_to(2 * np.pi * np.arange(SURFACE.mask.shape[1]) / 12, SURFACE.mask.shape)
    normal = np.stack([-np.cos(phase), np.zeros_like(phase), np.ones_like(phase)], axis=-1)
    return {"normal": (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
            "height": (PIXEL_M * 12 / (2 * np.pi) * np.sin(phase)).astype(np.float32)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("beyond")
    write_dome(folder / "cap", SURFACE, directions=LIGHTS, noise=0.01)
    return folder, sky(folder, SUN_DEGREES)


@pytest.mark.parametrize("wrong", ["nothing", "albedo", "normals"])
def test_guided_frames_are_nearer_to_the_truth_than_plain_ones(relit, scene, tmp_path, wrong):
    """With an albedo that is off by half, a correction in radiance is off by as much and leaves black patches; shares are not. Normals of
    another surface explain no captured light, and so change little."""
    folder, truth = scene
    changes = {"nothing": {}, "albedo": {"diffuse_albedo": patchy()},
               "normals": ripples()}[wrong]
    maps = write_maps(tmp_path / "maps", SURFACE, **changes)
    plain = min(SURFACE.off(relight(relit, folder, tmp_path / w, "--weights", w)[0], truth) for w in ("kernel", "cells", "smooth"))
    frame, _ = relight(relit, folder, tmp_path / "guided", "--maps", maps)
    assert SURFACE.off(frame, truth) < {"nothing": 0.02, "albedo": 0.1, "normals": 1.0}[wrong] * plain
    if wrong == "albedo":
        lit = SURFACE.mask & (truth.mean(axis=-1) > 0.2 * truth.mean(axis=-1).max())
        assert (frame[lit].mean(axis=-1) > 0.5 * truth[lit].mean(axis=-1)).mean() > 0.99


def test_the_share_of_such_light_is_said(relit, scene, tmp_path):
    folder, _ = scene
    maps = write_maps(tmp_path / "maps", SURFACE)
    for options, words in (((), "the nearest captured lights stand in"), (("--maps", maps), "the model of the maps is followed")):
        _, out = relight(relit, folder, tmp_path / str(len(options)), *options)
        warning, = (line for line in out.splitlines() if line.startswith("warning"))
        share = float(warning.split()[1])
        assert words in warning and "of the light of frame 1 comes from directions more than 2" in warning
        # of the texels: the sun and, as 0.01 everywhere, what of the sky is 22 degrees beyond
        assert share == pytest.approx(100, abs=2)


def test_nothing_is_said_where_the_light_was_captured(relit, tmp_path):
    write_dome(tmp_path / "cap", SURFACE, directions=LIGHTS)
    sky(tmp_path, 25)
    assert "warning" not in relight(relit, tmp_path, tmp_path / "a")[1]
    write_dome(tmp_path / "round" / "cap", SURFACE)
    sky(tmp_path / "round", SUN_DEGREES)
    assert "warning" not in relight(relit, tmp_path / "round", tmp_path / "b")[1]


def test_shade_is_guided_beyond_too(relit, scene, tmp_path):
    """A point light far away in the direction of the sun, and the environment."""
    folder, _ = scene
    maps = write_maps(tmp_path / "maps", SURFACE, diffuse_albedo=patchy())
    tilt = np.radians(SUN_DEGREES)
    towards = np.array([np.sin(tilt) * 0.8, np.sin(tilt) * 0.6, np.cos(tilt)])
    light = [*(100 * towards), 1e4, 1e4, 1e4]
    relit.done("shade", maps, "--light", ",".join(f"{v:.6f}" for v in light), "--capture", folder / "cap", "--out", tmp_path / "a.exr")
    truth = reflect(SURFACE.normal, towards) * SURFACE.mask[..., None]
    assert SURFACE.off(rgb(tmp_path / "a.exr"), truth) < 0.1
    outcome = relit("shade", maps, "--environment", folder / "sky.exr", "--capture", folder / "cap", "--out", tmp_path / "b.exr")
    assert "of the light of the picture comes from" in outcome.out
