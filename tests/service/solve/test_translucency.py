"""Bodies that scatter light below their surface are told from opaque ones, and their normals are as unsure as they are wrong."""

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.formats import exr
from tests.scenes.captures import write_image
from tests.scenes.translucent import Body, write

pytestmark = pytest.mark.long


def solved(folder, body, method=Method.ROBUST, **scene):
    """The error of each solved normal over its σ, and the warnings."""
    normal = write(folder / "capture", body, **scene)
    result = solve(SolveRequest(capture=folder / "capture", out=folder / "maps", method=method, device="cpu"))
    maps = result.maps
    assert maps.mask.mean() > 0.98
    error = np.degrees(np.arccos(np.clip((maps.normal * normal).sum(axis=-1), -1, 1)))
    return error[maps.mask] / maps.sigma[maps.mask], " ".join(result.warnings)


@pytest.mark.parametrize(("lengths", "seed"), [((1.0, 0.7, 0.5), 1), ((2.1, 1.5, 1.05), 2), ((3.5, 2.5, 1.75), 3), ((5.0, 2.0, 1.0), 6)])
@pytest.mark.parametrize("method", [Method.ROBUST, Method.SVBRDF])
def test_normals_of_translucent_bodies_are_as_unsure_as_they_are_wrong(tmp_path, method, lengths, seed):
    """Without what shadows tell, 5 to 63 % of the normals are wrong by more than five σ."""
    ratio, said = solved(tmp_path, Body(lengths=lengths), method, seed=seed)
    assert "translucent" in said and "in the colour that the object absorbs more" in said
    assert 0.3 < np.median(ratio) < 1.5  # 0.83 where σ is right; of a blur that is known by its width alone within a factor of two
    assert (ratio > 5).mean() < 0.02


@pytest.mark.parametrize("body", [Body(), Body(lens_px=0.9), Body(bounced=(0.3, 0.2, 0.1)), Body(lens_px=0.6, bounced=(0.4, 0.2, 0.05))],
                                     ids=["sharp", "blurred by the lens", "in bounced light", "both"])
@pytest.mark.parametrize("seed", [4, 5])
def test_opaque_bodies_are_not_taken_for_translucent_ones(tmp_path, body, seed):
    assert "translucent" not in solved(tmp_path, body, seed=seed)[1]


@pytest.mark.parametrize(("body", "noise"), [(Body(albedo=(0.6, 0.2, 0.03)), 0.01),
                                             (Body(albedo=(0.6, 0.3, 0.08), bounced=(0.5, 0.3, 0.1)), 0.02)])
def test_noise_makes_no_sharp_edges_of_the_darker_colour(tmp_path, body, noise):
    """Where noise of the dark colour chooses the edges, they are up to 1.4 times as sharp in it."""
    assert "translucent" not in solved(tmp_path, body, noise=noise, seed=1)[1]


def test_jpegs_are_not_judged(tmp_path):
    """Their colours are stored at half the resolution, and dark ones coarsely."""
    body = Body(albedo=(0.6, 0.3, 0.08), lengths=(1.0, 0.7, 0.5))
    assert "translucent" in solved(tmp_path, body, seed=1)[1]
    for path in sorted((tmp_path / "capture").glob("*.exr")):
        channels, _ = exr.read(path)
        image = np.clip(np.stack([channels[name] for name in "RGB"], axis=-1), 0, 1)
        write_image(path.with_suffix(".jpg"), np.round(255 * image).astype(np.uint8))
    manifest = tmp_path / "capture" / "capture.json"
    manifest.write_text(manifest.read_text().replace(".exr", ".jpg"))
    result = solve(SolveRequest(capture=manifest.parent, out=tmp_path / "maps", method=Method.ROBUST, device="cpu"))
    assert "translucent" not in " ".join(result.warnings)
