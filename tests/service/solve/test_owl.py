"""The shipped owl under other choices than those of the demo, whose results tests/service/demo compares with its truth."""

import numpy as np
import pytest

from benchmarks.material_picture import jumps
from stage.results.maps import SurfaceMaps
from tests.service.owl import owl_errors, write_small_owl

SIDE = 2


@pytest.mark.long
def test_neighbours_agree_on_materials_unless_each_pixel_is_asked_for(relit, tmp_path):
    """Half of the speckle of roughness goes, and with it a tenth of the error; normals, albedo and their σ are the same. At half of its
    resolution, because in blocks of 4 × 4 pixels neighbours are of different materials."""
    owl, found = write_small_owl(tmp_path / "owl", SIDE), {}
    for materials in ("coherent", "each-pixel"):
        relit.done("solve", owl, "--out", tmp_path / materials, "--materials", materials, "--device", "cpu")
        found[materials] = SurfaceMaps.read(tmp_path / materials / "maps.exr", unsure=True)
    coherent, alone = found["coherent"], found["each-pixel"]
    for layer in ("normal", "diffuse_albedo", "sigma", "height"):
        np.testing.assert_array_equal(getattr(coherent, layer), getattr(alone, layer))
    assert jumps(coherent.roughness, alone.estimated) < 0.5 * jumps(alone.roughness, alone.estimated)
    assert owl_errors(coherent, SIDE).roughness.mean() < 0.9 * owl_errors(alone, SIDE).roughness.mean()
