"""The shipped owl, solved by the default method, against its truth."""

import json

import numpy as np
import pytest

from benchmarks.material_picture import jumps
from kernels.status import Status
from service.requests.solve import MAX_SIGMA
from stage.results.maps import SurfaceMaps
from tests.service.owl import owl_errors, write_small_owl

SIDE = 4


def check_one_sigma(maps, counts):
    """Confidence is 1/(1 + σ), to half rounding of both, and the status and the report's counts follow from σ of the file."""
    kept = maps.estimated
    np.testing.assert_allclose(maps.confidence[kept], 1 / (1 + maps.sigma[kept]), rtol=2e-3)
    ambiguous, unsure = (maps.sigma > 5) & (maps.sigma <= MAX_SIGMA) & kept, (maps.sigma > MAX_SIGMA) & kept
    assert np.array_equal(maps.status == Status.AMBIGUOUS, ambiguous) and np.array_equal(maps.status == Status.UNSURE, unsure)
    assert counts["ambiguous"] == ambiguous.sum() > 0 and counts["unsure"] == unsure.sum()


def test_a_small_owl_is_solved_by_the_default_method_and_is_as_good_as_it_was(relit, tmp_path):
    """At a quarter of its resolution, where it takes seconds; the whole owl is solved by the demo (tests/service/demo).

    What bounds the errors is not the solver's arithmetic: blocks of 4 × 4 pixels hold feathers of several normals and materials,
    and the path-traced light that the owl throws on itself. Each limit is a tenth above what was measured when this was written.
    """
    relit.done("solve", write_small_owl(tmp_path / "owl", SIDE), "--out", tmp_path / "out", "--device", "cpu")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["method"] == "svbrdf" and report["suspect_lights"] == []
    every = SurfaceMaps.read(tmp_path / "out" / "maps.exr", unsure=True)
    check_one_sigma(every, report["pixels"])
    errors = owl_errors(every, SIDE)
    assert errors.solved == 1
    assert np.median(errors.normal) < 2.25 and errors.normal.mean() < 5.55  # 2.04 and 5.04 degrees
    assert np.median(errors.albedo) < 0.048  # 0.044
    assert np.median(errors.roughness) < 0.107  # 0.097: a mixture of lobes looks rougher than each
    assert errors.height < 0.054  # 0.049


@pytest.mark.long
def test_neighbours_agree_on_materials_unless_each_pixel_is_asked_for(relit, tmp_path):
    """Half of the speckle of roughness goes, and with it a tenth of the error; normals, albedo and their σ are the same. At half of its
    resolution, because in blocks of 4 × 4 pixels neighbours are of different materials."""
    side = SIDE // 2
    owl, found = write_small_owl(tmp_path / "owl", side), {}
    for materials in ("coherent", "each-pixel"):
        relit.done("solve", owl, "--out", tmp_path / materials, "--materials", materials, "--device", "cpu")
        found[materials] = SurfaceMaps.read(tmp_path / materials / "maps.exr", unsure=True)
    coherent, alone = found["coherent"], found["each-pixel"]
    for layer in ("normal", "diffuse_albedo", "sigma", "height"):
        np.testing.assert_array_equal(getattr(coherent, layer), getattr(alone, layer))
    assert jumps(coherent.roughness, alone.estimated) < 0.5 * jumps(alone.roughness, alone.estimated)
    assert owl_errors(coherent, side).roughness.mean() < 0.9 * owl_errors(alone, side).roughness.mean()
