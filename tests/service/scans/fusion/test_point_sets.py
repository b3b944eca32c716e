"""Sets of points that are fused: as good as range images with as many pixels, and refused where nothing says what they saw."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.errors import RequestError
from service.requests.register import RegisterRequest
from service.scans.fusion.prepared_scans import as_range_image
from service.scans.points.planes import local_planes
from service.scans.points.ply_points import read_ply_points
from service.scans.read import read_scan
from service.scans.register import register_scans
from stage.errors import ManifestError
from stage.formats.ply import PointCloud, write_ply
from stage.sets.scan_set import read_scan_set
from tests.scenes.clouds import MM, Cloud, all_around, entry, scatter
from tests.scenes.register import fuse_scans
from tests.scenes.statue import SIGMA, colour_of, distance, place, turntable, write_scans, write_set

VOXEL = 4e-3
RAYS = 160 * 120
VIEWS = 9


@pytest.fixture(scope="module")
def clouds() -> list[Cloud]:
    return all_around(VIEWS, RAYS)


@pytest.fixture(scope="module")
def coarse() -> list[Cloud]:
    """The first of these, and of the others a tenth of their points, where these are only looked at or refused."""
    return all_around(1, RAYS) + all_around(VIEWS, RAYS // 10)[1:]


def fused(file, **changes):
    return fuse_scans(file, file.parent / "out", voxel_m=VOXEL, **changes)


def errors(result) -> np.ndarray:
    return np.abs(distance(read_ply_points(result.mesh_path).points))


@pytest.mark.long
def test_points_are_fused_as_well_as_range_images(tmp_path, clouds):
    (tmp_path / "clouds").mkdir()
    points = fused(write_set(tmp_path / "clouds", [entry(cloud, tmp_path / "clouds", number) for number, cloud in enumerate(clouds)]))
    images = fused(write_scans(tmp_path / "images", turntable(VIEWS, (160, 120))))
    found, beside = errors(points), errors(images)
    assert np.median(found) < 1.2 * np.median(beside) < 1.2 * SIGMA
    assert np.percentile(found, 90) < 2 * np.percentile(beside, 90)  # edges are blurred by a pixel more
    assert points.facts["area_m2"] > 0.95 * images.facts["area_m2"]
    assert all(scan["fused"] for scan in points.facts["scans"]) and not [w for w in points.warnings if "pose" in w]
    ply = read_ply_points(points.mesh_path)
    off = np.abs(ply.colours.astype(int) - colour_of(ply.points)).max(axis=1)
    assert np.percentile(off, 95) < 15  # over 1.25 pixels of 7.5 mm the colour changes by 9 of 255


@pytest.mark.long
def test_points_and_range_images_make_one_surface(tmp_path, clouds):
    shots = turntable(VIEWS, (160, 120))
    file = write_scans(tmp_path, shots)
    listed = json.loads(file.read_text())["scans"]
    for number in range(0, VIEWS, 2):
        listed[number] = entry(clouds[number], tmp_path, number)
    result = fused(write_set(tmp_path, listed))
    assert np.median(errors(result)) < SIGMA and all(scan["fused"] for scan in result.facts["scans"])


@pytest.mark.long
def test_a_range_image_of_points_says_what_the_scanner_saw(tmp_path, coarse):
    """Each pixel lies on the true surface by what its σ says, in the world; σ is at most that of a point."""
    file, listed = read_scan_set(write_set(tmp_path, [entry(coarse[0], tmp_path, 0)]))
    scan = as_range_image(read_scan(file, listed, 0), "cloud 0", device="cpu")
    world = scan.points @ scan.pose[:3, :3].T + scan.pose[:3, 3]
    off = distance(world)
    assert np.sqrt(np.median(off**2)) < 0.6745 * SIGMA
    assert np.median(scan.sigma) < SIGMA and (scan.sigma < 1.01 * SIGMA).mean() > 0.6  # the others lie at edges, 7 pixels to a part
    viewpoint = coarse[0].world_from_file[:3, :3] @ coarse[0].viewpoint + coarse[0].world_from_file[:3, 3]
    assert scan.pose[:3, 3] == pytest.approx(viewpoint, abs=1e-9)
    assert 0.7 * len(coarse[0].points) < len(scan.points) < 1.2 * len(coarse[0].points)


@pytest.mark.parametrize("voxel_pixels", [None, 1.0, 4.0, 8.0, 20.0])
def test_one_scan_of_a_wall_is_whole_whatever_the_voxels(tmp_path, voxel_pixels):
    """Random points leave no holes, and pixels of many points are as sure as these say together."""
    rng = np.random.default_rng(3)
    across, up = rng.uniform(-0.5, 0.5, (2, 20000))
    depth = 1 / (0.5 - 0.05 * across) + SIGMA * rng.standard_normal(20000)
    wall = Cloud(np.stack([across * depth, up * depth, -depth], axis=1), np.zeros((20000, 3), np.uint8), np.eye(4), np.zeros(3))
    pixel = 2 / np.sqrt(20000)
    file, listed = read_scan_set(write_set(tmp_path, [entry(wall, tmp_path, 0)]))
    voxel = None if voxel_pixels is None else voxel_pixels * pixel
    scan = as_range_image(read_scan(file, listed, 0), "wall", voxel, device="cpu")
    inside = np.zeros((scan.camera.height, scan.camera.width), dtype=bool)
    inside.flat[scan.pixels] = True
    assert inside[3:-3, 3:-3].mean() > 0.995
    own = scan.points @ scan.pose[:3, :3].T + scan.pose[:3, 3]
    off = (-own[:, 2] - 1 / (0.5 + 0.05 * own[:, 0] / own[:, 2])) / scan.sigma
    assert np.sqrt((off**2).mean()) == pytest.approx(1, abs=0.25)  # the larger the pixels, the fewer: 484 of the largest


def test_points_at_the_scanner_are_no_returns(tmp_path, coarse):
    one = coarse[0]
    more = one._replace(points=np.vstack([one.points, np.tile(one.viewpoint, (300, 1))]),
                        colours=np.vstack([one.colours, one.colours[:300]]))
    file, listed = read_scan_set(write_set(tmp_path, [entry(more, tmp_path, 0), entry(one, tmp_path, 1)]))
    found, beside = (read_scan(file, listed, number) for number in (0, 1))
    assert np.array_equal(found.points, beside.points) and len(found.colours) == len(beside.colours)
    none = one._replace(points=np.tile(one.viewpoint, (300, 1)), colours=one.colours[:300])
    file, listed = read_scan_set(write_set(tmp_path, [entry(none, tmp_path, 0)]))
    with pytest.raises(ManifestError, match="has no point with a σ above 0 that is not at viewpoint_m"):
        read_scan(file, listed, 0)


def test_what_cannot_have_been_seen_from_a_place_is_refused(tmp_path, coarse):
    def refused(words: str, *entries: dict, error=RequestError):
        with pytest.raises(error, match=words):
            fused(write_set(tmp_path, list(entries)))
        assert not (tmp_path / "out").exists()

    one = coarse[0]
    refused(r"scans\[0\] \(cloud 0\): viewpoint_m is missing: cloud0.ply", entry(one, tmp_path, 0, viewpoint_m=None))
    inside = one.points.mean(axis=0)
    refused("the middle of what is seen from viewpoint_m; at most 55°",
            entry(one, tmp_path, 0, viewpoint_m=inside.tolist()))
    all_sides = _in_one_file(coarse)
    refused("points lie before or behind others as seen from viewpoint_m",
            entry(all_sides, tmp_path, 0))
    near = np.linalg.norm(one.points - one.points[0], axis=1) < 0.06
    apart = np.vstack([one.points[near], one.viewpoint + (one.points[:5] - one.viewpoint) @ Rotation.from_euler("x", 0.8).as_matrix()])
    refused(r"are spread over \d+ x \d+ pixels as seen from viewpoint_m",
            entry(one._replace(points=apart, colours=one.colours[:len(apart)]), tmp_path, 0))
    for points in (one.points[:1].repeat(500, axis=0), one.points[0] + np.linspace(0, 0.3, 500)[:, None] * [1, 0, 0]):
        refused(r"\(cloud 0\): its 500 points",
                entry(one._replace(points=points, colours=one.colours[:500]), tmp_path, 0))
    refused(r"viewpoint_m\[0\]: is 1e\+200: input should be less than or",
            entry(one, tmp_path, 0, viewpoint_m=[1e200, 0, 0]), error=ManifestError)
    shots = write_scans(tmp_path / "images", turntable(1, (80, 60)))
    listed = json.loads(shots.read_text())["scans"]
    refused(r"viewpoint_m: depth.exr has a camera", {**listed[0], "path": "images/scan0", "viewpoint_m": [0, 0, 0]}, error=ManifestError)


def test_normals_that_point_away_from_the_viewpoint_are_refused(tmp_path, coarse):
    """From behind, each point of a scan can be seen but for the parts in front; only normals say that it shows the inside."""
    normals = local_planes(coarse[0].points, origin=coarse[0].viewpoint).normals
    behind = coarse[0].points.mean(axis=0) * 2 - coarse[0].viewpoint
    said = entry(coarse[0], tmp_path, 0, viewpoint_m=behind.tolist())
    write_ply(PointCloud((MM * coarse[0].points).astype(np.float32), coarse[0].colours, normals), tmp_path / said["path"])
    read, listed = read_scan_set(write_set(tmp_path, [said]))
    with pytest.raises(RequestError, match=r"\d\d% of its normals point away from viewpoint_m"):
        as_range_image(read_scan(read, listed, 0), "cloud 0", device="cpu")


@pytest.mark.long
def test_registered_scans_keep_their_viewpoints(tmp_path):
    clouds = [scatter(place(angle, 0.1, 2.0), 40 * RAYS // 100, seed=number) for number, angle in enumerate((0.0, 0.3))]
    file = write_set(tmp_path, [entry(cloud, tmp_path, number) for number, cloud in enumerate(clouds)])
    register_scans(RegisterRequest(scan_set=file, out=tmp_path / "out", poses="refined"))
    _, listed = read_scan_set(tmp_path / "out")
    for cloud, scan in zip(clouds, listed.scans, strict=True):
        assert scan.viewpoint_m == pytest.approx(tuple(cloud.viewpoint))


def _in_one_file(clouds: list[Cloud]) -> Cloud:
    """All scans in the frame of the first, as if they were one scan from its place."""
    first = np.linalg.inv(clouds[0].world_from_file)
    parts = [(cloud.points @ cloud.world_from_file[:3, :3].T + cloud.world_from_file[:3, 3]) @ first[:3, :3].T + first[:3, 3]
             for cloud in clouds]
    return clouds[0]._replace(points=np.vstack(parts), colours=np.vstack([cloud.colours for cloud in clouds]))
