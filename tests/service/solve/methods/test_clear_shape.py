"""The shape of the diffuse lobe of an object in whose trough light bounces, told by what bulges beside it."""

import json

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.height.interreflection import ArrivingLight
from service.solve.solve import solve
from tests.reference import microfacet
from tests.reference.groove import Trough
from tests.reference.sampling import lattice
from tests.scenes.captures import distant, write_lit

SIDE, ALBEDO, ROUGHNESS = 24, 0.7, 0.4
TO_VIEWER = np.array([0.0, 0.0, 1.0])


@pytest.mark.long
def test_bounced_light_is_no_shape_of_the_lobe(tmp_path):
    """As a whole it looks like a Lambertian one. Tolerance: the shapes that are tried are 0.075 in roughness apart."""
    lights, trough = lattice(32, 70.0), Trough(SIDE, 1.6)
    x, y = (part.ravel() for part in np.meshgrid(*2 * [(np.arange(SIDE) + 0.5) / SIDE * 2 - 1]))
    bulge = microfacet.unit(np.stack([0.9 * x, -0.9 * y, np.ones_like(x)], axis=-1))

    def lit(normals):
        return (ALBEDO * microfacet.diffuse(normals[None], lights[:, None], TO_VIEWER, ROUGHNESS)
                + microfacet.specular(normals[None], lights[:, None], TO_VIEWER, 0.2, 0.04))

    direct = np.where(trough.shadowed(lights), 0, lit(trough.normals))
    whole = np.linalg.solve(np.eye(SIDE**2) - ALBEDO * trough.factors(), direct.T).T
    images = np.concatenate([each.reshape(-1, SIDE, SIDE) for each in (whole, lit(bulge))], axis=2)
    write_lit(tmp_path, images, [distant(light, 1.0) for light in lights],
              camera={"projection": "orthographic", "resolution": [2 * SIDE, SIDE]})
    solve(SolveRequest(capture=tmp_path, out=tmp_path / "out", device="cpu", method=Method.SVBRDF))
    found = json.loads((tmp_path / "out" / "report.json").read_text())["found"]
    assert found["bounced_light"]["taken_out"]
    assert found["diffuse_roughness"] == pytest.approx(ROUGHNESS, abs=0.075)
    assert found["diffuse_slope"] == 0


def test_arriving_light_is_the_mean_of_all_lights_and_channels():
    """Two patches of two pixels, of which the second gets as much again; between their middles it grows in proportion."""
    light = np.arange(12, dtype=np.float32).reshape(1, 3, 4) * np.array([1, 2], np.float32)[:, None, None]
    arriving = ArrivingLight(light, np.array([[0, 1]]), 2)
    got = arriving.mean_at(np.zeros(4, int), np.arange(4))
    assert got == pytest.approx(5.5 * np.array([1, 1.25, 1.75, 2]), rel=1e-6)  # float32
