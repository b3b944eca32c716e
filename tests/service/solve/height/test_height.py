"""relit solve: the height of surfaces whose normals the method cannot find."""

import json

import numpy as np

from kernels.status import Status
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.results.maps import SurfaceMaps
from tests.scenes import captures

SHARPNESS = 12
"""Exponent of the highlight of the metal: some 20 degrees wide."""


def metal_cap(folder, lights=24):
    """A cap that reflects as metal does (Blinn), on which no reading is Lambertian."""
    scene = captures.make_scene(size=40, lights=2)
    i = np.arange(lights) + 0.5
    z, turn = 1 - 0.7 * i / lights, np.pi * (1 + 5**0.5) * i
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    half = directions + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1)[:, None]
    lobe = np.maximum(np.einsum("rcx,lx->lrc", scene.normal, half), 0) ** SHARPNESS
    lobe *= np.einsum("rcx,lx->lrc", scene.normal, directions) > 0
    lobe *= 1 + 0.005 * np.random.default_rng(0).normal(size=lobe.shape)
    images = lobe[..., None] * [0.9, 0.7, 0.4] * scene.mask[None, ..., None]
    return captures.write_capture(folder, scene._replace(directions=directions, irradiance=np.ones((lights, 3)), images=images)), scene


def test_metal_by_robust_is_unsure_has_no_spikes_and_says_so(tmp_path):
    folder, scene = metal_cap(tmp_path / "capture")
    result = solve(SolveRequest(capture=folder, out=tmp_path / "out", method=Method.ROBUST, device="cpu"))
    maps = SurfaceMaps.read(tmp_path / "out" / "maps.exr", unsure=True)
    error = captures.angles_degrees(maps.normal, scene.normal)
    assert np.median(error[maps.estimated]) > 20
    assert (maps.confidence[maps.estimated] < 0.1).all() and (error > 5 * maps.sigma)[maps.estimated].mean() < 0.01
    assert (maps.status == Status.UNSURE).sum() > 0.5 * maps.estimated.sum()
    true_height = 20 / np.sin(np.radians(45)) * scene.normal[..., 2]  # of a sphere, in pixels
    span = np.ptp(maps.height[maps.estimated]) / np.ptp(true_height[scene.mask])
    assert span < 5  # 11 where every normal counts as sure: nearly all of these are tilted twice as far as the surface
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["height"]["guessed_part"] > 0.1
    assert [w for w in result.warnings if w.startswith("height: ") and w.endswith("try --method svbrdf, which knows highlights and metals")]
    assert report["warnings"] == list(result.warnings)


def test_a_matt_surface_has_no_such_warning(tmp_path):
    folder = captures.write_capture(tmp_path / "capture", captures.make_scene(size=24, lights=12))
    for method in (Method.LAMBERT, Method.ROBUST):
        result = solve(SolveRequest(capture=folder, out=tmp_path / method, method=method, device="cpu"))
        assert not [w for w in result.warnings if w.startswith("height")]
        assert json.loads((tmp_path / method / "report.json").read_text())["height"]["guessed_part"] == 0
