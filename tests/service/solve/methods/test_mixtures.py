"""A dome of metal and paint with a soft border between them: what its maps are worth under a light that is not in the capture."""

import json

import numpy as np
import pytest

from stage.formats import exr
from tests.reference import microfacet
from tests.scenes.captures import rgb
from tests.scenes.glossy import VIEW, dome, sphere_directions, write_lit

SURFACE = dome(26)
GOLD, PAINT = np.array([0.95, 0.68, 0.35]), np.array([0.5, 0.3, 0.15])
METAL_ROUGHNESS, PAINT_ROUGHNESS = 0.35, 0.5
BORDER_PIXELS = 10
SHARE = np.clip((np.arange(26) + 0.5 - 13) / BORDER_PIXELS + 0.5, 0, 1)[None, :, None]
PLACE = np.array([0.012, 0.01, 0.035])


def reflect(toward):
    """[rows, cols, 3] radiance under unit irradiance."""
    metal = np.stack([microfacet.specular(SURFACE.normal, toward, VIEW, METAL_ROUGHNESS**2, f0) for f0 in GOLD], axis=-1)
    shine = microfacet.specular(SURFACE.normal, toward, VIEW, PAINT_ROUGHNESS**2, 0.04)[..., None]
    return SHARE * metal + (1 - SHARE) * (PAINT * microfacet.diffuse(SURFACE.normal, toward, VIEW)[..., None] + shine)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder, random = tmp_path_factory.mktemp("border"), np.random.default_rng(1)

    def seen(direction):
        image = np.pi * reflect(direction) * SURFACE.mask[..., None]
        return np.maximum(image + 0.003 * random.normal(size=image.shape), 0)

    write_lit(folder, SURFACE.mask, sphere_directions(64), seen, irradiance=np.pi)
    return folder


@pytest.mark.long
def test_a_highlight_on_the_border_of_metal_and_paint(relit, capture, tmp_path):
    """A near light whose highlight lies on the border. With one lobe a pixel the relative error there is 0.11, with two 0.05.
    Tolerance: noise of the gold that pixels share, and the height that the solved normals give."""
    assert relit("solve", capture, "--method", "svbrdf", "--out", tmp_path / "maps", "--device", "cpu").code == 0
    path = tmp_path / "maps" / "maps.exr"
    channels, _ = exr.read(path)
    abundance = channels["abundance.Y"].astype(np.float64)
    solved, share = channels["mask.Y"] > 0, np.broadcast_to(SHARE[..., 0], SURFACE.mask.shape)
    assert (abundance[solved & (share > 0.15) & (share < 0.5)] > 0).mean() > 0.8
    assert (abundance[solved & ((share == 0) | (share == 1))] > 0).mean() < 0.02
    np.testing.assert_array_equal(rgb(path, "first_specular.")[abundance == 0], 0)
    assert json.loads((tmp_path / "maps" / "report.json").read_text())["found"]["mixed_pixels"] == (abundance > 0).sum()

    relit("shade", tmp_path / "maps", "--light", ",".join(map(str, [*PLACE, 1e-3, 1e-3, 1e-3])), "--out", tmp_path / "near.exr")
    toward = PLACE - SURFACE.places
    away = np.linalg.norm(toward, axis=-1, keepdims=True)
    wanted, got = reflect(toward / away)[solved] * 1e-3 / away[solved] ** 2, rgb(tmp_path / "near.exr")[solved]
    border = (abundance > 0)[solved]
    assert np.sqrt(((got - wanted)[border] ** 2).sum() / (wanted[border] ** 2).sum()) < 0.07
    assert got.sum() == pytest.approx(wanted.sum(), rel=0.02)
