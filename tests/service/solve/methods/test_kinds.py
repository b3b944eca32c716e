"""A glazed dome beside a matt one, whose diffuse reflection is another: each is solved under a lobe of its own."""

import json

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.results.maps import SurfaceMaps
from tests.reference import microfacet
from tests.scenes.glossy import VIEW, dome, sphere_directions, write_lit

pytestmark = pytest.mark.long

SURFACE = dome(26)
GLAZED, MATT = slice(0, 26), slice(30, 56)
MATT_ROUGHNESS, F0 = 0.75, 0.04
GREEN, WHITE = np.array([0.2, 0.35, 0.25]), np.array([0.75, 0.72, 0.65])


def beside(left, right):
    """Two images with a gap of four columns between them."""
    return np.concatenate([left, np.zeros_like(left[:, :4]), right], axis=1)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder, random = tmp_path_factory.mktemp("domes"), np.random.default_rng(1)

    def seen(direction):
        glazed = (GREEN * microfacet.diffuse(SURFACE.normal, direction, VIEW)[..., None]
                  + microfacet.specular(SURFACE.normal, direction, VIEW, 0.3**2, F0)[..., None])
        matt = (WHITE * microfacet.diffuse(SURFACE.normal, direction, VIEW, MATT_ROUGHNESS)[..., None]
                + microfacet.specular(SURFACE.normal, direction, VIEW, MATT_ROUGHNESS**2, F0)[..., None])
        image = beside(glazed, matt) * mask[..., None]
        return np.maximum(image + 0.002 * random.normal(size=image.shape), 0)

    mask = beside(SURFACE.mask, SURFACE.mask)
    write_lit(folder, mask, sphere_directions(64), seen, irradiance=1)
    solve(SolveRequest(capture=folder, method=Method.SVBRDF, out=folder / "maps", device="cpu"))
    return SurfaceMaps.read(folder / "maps" / "maps.exr"), json.loads((folder / "maps" / "report.json").read_text())["found"]


def test_each_body_has_a_lobe_of_its_own(found):
    """Steps of the shapes that are tried: 0.075 in roughness."""
    _, facts = found
    glazed, matt = facts["other_parts"]
    assert glazed["pixels"] == matt["pixels"] == SURFACE.mask.sum()
    assert glazed["diffuse_roughness"] is None and abs(matt["diffuse_roughness"] - MATT_ROUGHNESS) < 0.075


@pytest.mark.parametrize(("body", "roughness", "albedo"), [(GLAZED, 0.3, GREEN), (MATT, MATT_ROUGHNESS, WHITE)])
def test_normals_and_materials_of_both(found, body, roughness, albedo):
    """With one lobe for both, F0 of the matt body is 0.2 and its albedo 0.69. Tolerance: noise of 0.002, and the steps of the shapes."""
    maps = found[0]
    normal, specular, rough, diffuse = (layer[:, body][SURFACE.mask] for layer in (
        maps.normal, maps.specular, maps.roughness, maps.diffuse_albedo))
    off = np.degrees(np.arccos(np.clip((normal * SURFACE.normal[SURFACE.mask]).sum(-1), -1, 1)))
    assert np.median(off) < 0.3
    assert abs(np.median(specular) - F0) < 0.01 and abs(np.median(rough) - roughness) < 0.03
    np.testing.assert_allclose(np.median(diffuse, axis=0), albedo, rtol=0.03)
