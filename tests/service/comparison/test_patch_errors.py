"""σ of patches whose points share errors: white noise, readings that several points share, and a fused surface."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.comparison.compare import compare
from service.comparison.deviations import Patches, deviations_of, patches_of
from service.comparison.placing import Placement
from service.comparison.surfaces import read_design, read_scanned
from service.requests.register import Alignment, CompareRequest, FuseRequest
from service.scans.fusion.fuse import fuse
from tests.scenes.machined_part import SIGMA_M, Part, Scanned, machined_part, scan_of, write_scan, write_stl
from tests.scenes.statue import turntable, write_scans

HERE = Placement(np.eye(4), np.zeros(3), np.zeros((6, 6)), 0, 0, 0.0)
COUNT = 15_000
PATCH_M = 3.6e-3
"""Side of a patch: it holds some sixteen points, as by default."""


def shared_scan(seed: int) -> Scanned:
    """A part scanned with white noise, and as much that is common to the points of each of some 4000 places."""
    random = np.random.default_rng(seed)
    plain = scan_of(machined_part(), random, COUNT)
    place = cKDTree(plain.points[:COUNT // 4]).query(plain.points)[1]
    return plain._replace(points=plain.points + plain.normals * random.normal(0, SIGMA_M, COUNT)[place][:, None])


def patches(design, scan, patch_m: float = PATCH_M) -> Patches:
    read = read_design(design, 1e-3, device="cpu")
    found = deviations_of(read, read_scanned(scan, 1.0, None), HERE, 2e-3)
    return patches_of(found, read, HERE, patch_m=patch_m, shared_m=0.0)


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    return write_stl(tmp_path_factory.mktemp("design") / "part.stl", machined_part())


@pytest.mark.parametrize("dent_m", [0.0, 1.5e-4])
def test_white_noise_and_faults_keep_the_σ_of_points(tmp_path, design, dent_m):
    def fault(points, normals):
        return np.where((np.hypot(points[:, 0] + 10, points[:, 1] - 15) < 4) & (normals[:, 2] > 0.9), -1e3 * dent_m, 0)

    scan = write_scan(tmp_path / "scan.ply", scan_of(machined_part(), np.random.default_rng(2), COUNT, fault=fault))
    found = patches(design, scan)
    assert found.shared_m == 0
    assert np.median(found.sigma * np.sqrt(found.points)) == pytest.approx(SIGMA_M)
    assert dent_m or (found.deviation / found.sigma).std() == pytest.approx(1, abs=0.1)  # of 900 patches


def test_a_mesh_without_any_noise_shares_no_error(tmp_path, design):
    found = patches(design, write_stl(tmp_path / "scan.stl", machined_part()._replace(points=1e-3 * machined_part().points)))
    assert np.abs(found.deviation).max() < 1e-8 and found.sigma.max() < 1e-3  # float32 of a mesh of 80 mm


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_readings_that_points_share_are_in_the_σ_of_patches(tmp_path, design, seed):
    scan = write_scan(tmp_path / "scan.ply", shared_scan(seed), np.sqrt(2) * SIGMA_M)
    found = patches(design, scan)
    assert (found.deviation / found.sigma).std() == pytest.approx(1, abs=0.12)  # of 900 patches, of some more points than others
    (tmp_path / "tolerances.json").write_text(json.dumps({"schema": "relit.tolerances/1", "unit": "mm", "regions": [
        {"name": "below", "facing": [0, 0, -1], "tolerance": [-0.008, 0.008]}]}))
    result = compare(CompareRequest(scan=scan, design=design, out=tmp_path / "out", device="cpu", align=Alignment.NONE,
                                    regions=tmp_path / "tolerances.json"))
    assert str(result.regions[0].verdict) == "undecided"  # all of the part is within
    assert json.loads(result.report_path.read_text())["patch_shared_error_m"] == pytest.approx(found.shared_m, rel=0.2)


def ball(radius_mm: float = 250.0, count: int = 300) -> Part:
    """A ball of triangles a two-hundredth of a millimetre within the round one."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, count // 2 + 1), 2 * np.pi * np.arange(count) / count, indexing="ij")
    points = radius_mm * np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], axis=-1)
    index = np.arange(points.shape[0] * count).reshape(-1, count)
    a, b, c, d = index[:-1], index[1:], np.roll(index[1:], -1, axis=1), np.roll(index[:-1], -1, axis=1)
    faces = np.concatenate([np.stack([a, c, b], axis=-1)[:-1].reshape(-1, 3), np.stack([a, d, c], axis=-1)[1:].reshape(-1, 3)])
    return Part(points.reshape(-1, 3), faces)


@pytest.mark.long
def test_a_fused_ball_deviates_by_the_σ_of_its_patches(tmp_path):
    """Voxels of half a pixel: several vertices share the reading of each pixel, with which deviation / σ would vary by 1.75."""
    shots = turntable(8, (192, 144), sigma=5e-4, range_m=1.6, scene=lambda points: np.linalg.norm(points, axis=-1) - 0.25)
    folder = tmp_path / "scans"
    folder.mkdir()
    write_scans(folder, shots, sigma=5e-4)
    mesh = fuse(FuseRequest(scan_set=folder, out=tmp_path / "fused", device="cpu", texture=False)).mesh_path
    found = patches(write_stl(tmp_path / "ball.stl", ball()), mesh, 0.012)
    assert 0.85 < (found.deviation / found.sigma).std() < 1.15
