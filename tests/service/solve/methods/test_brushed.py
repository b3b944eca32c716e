"""A turned lid: brushed metal whose scratches run around its middle, on a painted dome."""

import json

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.results.maps import SurfaceMaps
from tests.reference import microfacet
from tests.scenes.captures import angles_degrees
from tests.scenes.glossy import VIEW, dome, reflect, sphere_directions, write_lit

SIZE = 40
SURFACE = dome(SIZE)
ACROSS = np.arange(SIZE) - (SIZE - 1) / 2
LID = SURFACE.mask & (np.hypot(*np.meshgrid(ACROSS, ACROSS)) < 0.35 * SIZE)
ALUMINIUM, WIDTHS = np.array([0.91, 0.92, 0.92]), np.array([0.08, 0.3])


@pytest.mark.long
def test_a_turned_lid_is_solved_by_its_streaks(tmp_path):
    """Round lobes had its normals 6° off in the median, all of them ambiguous. Under 64 lights, of which half are above the horizon, with
    noise of a hundredth of each reading, they are within a tenth of a degree, and within 2.1 σ, at the 90th percentile; F0 within a
    hundredth, the roughness the root of the mean width. The paint beside it is not brushed."""
    around = microfacet.unit(np.cross([0.0, 0.0, 1.0], SURFACE.normal) + 1e-9)
    random = np.random.default_rng(3)

    def seen(direction):
        shine = np.stack([microfacet.streak(SURFACE.normal, around, direction, VIEW, WIDTHS, f0) for f0 in ALUMINIUM], axis=-1)
        image = np.where(LID[..., None], shine, reflect(SURFACE.normal, direction)) * SURFACE.mask[..., None]
        return image * (1 + 0.01 * random.normal(size=image.shape))

    write_lit(tmp_path, SURFACE.mask, sphere_directions(64), seen, irradiance=1)
    solve(SolveRequest(capture=tmp_path, method=Method.SVBRDF, out=tmp_path / "maps", device="cpu"))
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr", unsure=True)
    report = json.loads((tmp_path / "maps" / "report.json").read_text())
    off = angles_degrees(maps.normal, SURFACE.normal)
    assert abs(report["found"]["brushed_pixels"] - LID.sum()) <= 2
    assert np.percentile(off[LID], 90) < 0.1 and (off[LID] <= 2.1 * maps.sigma[LID]).mean() > 0.9
    np.testing.assert_allclose(np.median(maps.specular[LID], axis=0), ALUMINIUM, rtol=0.01)
    np.testing.assert_allclose(np.median(maps.roughness[LID]), WIDTHS.prod() ** 0.25, rtol=0.01)
    assert sum("are brushed" in warning for warning in report["warnings"]) == len(report["warnings"]) == 1
