"""The reader of scan sets: depth results and PLY files give points, σ along the line of sight, normals, colours and poses."""

from pathlib import Path

import numpy as np
import pytest

from service.scans.points.scan import Scan
from service.scans.read import read_scan
from stage.capture.camera import Camera
from stage.errors import ManifestError, StageError
from stage.formats.ply import PointCloud, write_ply
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from stage.sets.scan_set import read_scan_set
from tests.scenes.statue import write_set

SIZE, RADIUS, SIGMA = 96, 0.25, 2e-4
CAMERAS = {"perspective": Camera(projection="perspective", resolution=(SIZE, SIZE), focal_px=(120.0, 120.0)),
           "orthographic": Camera(projection="orthographic", resolution=(SIZE, SIZE), pixel_size_m=0.008)}


def sphere(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The z-depth of a sphere a metre in front of the camera, and where it is seen."""
    x, y = camera.plane_coordinates()
    if camera.projection == "orthographic":
        inside = x**2 + y**2 < (0.95 * RADIUS) ** 2
        return 1 - np.sqrt(np.where(inside, RADIUS**2 - x**2 - y**2, 0)), inside
    a = 1 + x**2 + y**2
    under = 1 - a * (1 - RADIUS**2)
    inside = under > 0.005
    return (1 - np.sqrt(np.where(inside, under, 0))) / a, inside


def write(folder: Path, name: str, kind: str = "perspective", *, sigma: bool = True, colours: bool = True, noise: float = 0.0,
          pose: list | None = None) -> None:
    camera = CAMERAS[kind].model_copy(update={"world_from_camera": None if pose is None else tuple(map(tuple, pose))})
    depth, mask = sphere(camera)
    depth = depth + noise * np.random.default_rng(1).standard_normal(depth.shape)
    (folder / name).mkdir(parents=True, exist_ok=True)
    DepthMaps(camera=camera, mask=mask, depth=depth.astype(np.float32),
              sigma=np.full(depth.shape, SIGMA, dtype=np.float32) if sigma else None).write(folder / name / "depth.exr")
    if colours:
        rows, cols = np.nonzero(mask)
        grey = np.stack([rows, cols, rows], axis=1).astype(np.uint8)
        write_ply(PointCloud(camera.points(-depth)[mask], grey), folder / name / "points.ply")


def read(folder: Path, *scans: dict) -> list[Scan]:
    file, listed = read_scan_set(write_set(folder, list(scans)))
    return [read_scan(file, listed, number) for number in range(len(listed.scans))]


@pytest.mark.parametrize("kind", list(CAMERAS))
def test_a_range_image_gives_points_sigma_colours_and_its_grid(tmp_path, kind):
    write(tmp_path, "a", kind)
    scan, = read(tmp_path, {"name": "a", "path": "a"})
    camera, (depth, mask) = CAMERAS[kind], sphere(CAMERAS[kind])
    assert scan.camera == camera and scan.pixels is not None and scan.normals is None and scan.colours is not None
    np.testing.assert_array_equal(scan.pixels, np.flatnonzero(mask))
    from_middle = scan.points + [0, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(from_middle, axis=1), RADIUS, atol=1e-6)
    along = np.abs(scan.directions()[:, 2]) * scan.sigma  # σ along the ray has the σ of the z-depth as its part along z
    np.testing.assert_allclose(along, SIGMA, rtol=1e-4)
    assert scan.sigma_source == "measured"
    np.testing.assert_array_equal(scan.colours[:, 0], np.nonzero(mask)[0])
    np.testing.assert_allclose(scan.image(-scan.points[:, 2]), np.where(mask, depth, 0), rtol=1e-6)
    assert scan.pose is None and scan.maps is None


def test_a_point_set_gives_points_in_metres_with_an_estimated_sigma(tmp_path):
    write(tmp_path, "a", noise=5e-4)
    source, = read(tmp_path, {"name": "a", "path": "a"})
    write_ply(PointCloud(1000 * source.points, np.zeros((len(source.points), 3), dtype=np.uint8)), tmp_path / "a.ply")
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    pose[0, 0] = 1.00003  # typed with four digits
    scan, other = read(tmp_path, {"name": "a", "path": "a.ply", "unit": "mm", "scan_to_world": pose.tolist()},
                       {"name": "b", "path": "a.ply", "unit": "mm", "sigma_m": 3e-4})
    np.testing.assert_allclose(scan.points, source.points, rtol=1e-5, atol=1e-7)
    assert scan.normals is None and scan.sigma_source == "estimated"
    assert 3e-4 < scan.sigma[0] < 2e-3  # the noise along the normal is smaller than along the ray; the bend of the sphere adds
    assert scan.pose is not None and np.abs(scan.pose[:3, :3] @ scan.pose[:3, :3].T - np.eye(3)).max() < 1e-15
    assert other.sigma_source == "declared" and other.sigma[0] == np.float32(3e-4)


def test_the_pose_of_a_rig_is_taken_from_the_depth_result_where_the_set_gives_none(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    write(tmp_path, "a", pose=pose.tolist())
    own, other = read(tmp_path, {"name": "a", "path": "a"}, {"name": "b", "path": "a", "scan_to_world": np.eye(4).tolist()})
    np.testing.assert_array_equal(own.pose, pose)
    np.testing.assert_array_equal(other.pose, np.eye(4))


def test_solved_maps_of_the_same_camera_stay_with_the_scan(tmp_path):
    write(tmp_path, "a", colours=False)
    _, mask = sphere(CAMERAS["perspective"])
    normal = np.zeros((SIZE, SIZE, 3), dtype=np.float32)
    normal[..., 2] = 1
    (tmp_path / "solved").mkdir()
    SurfaceMaps(camera=CAMERAS["perspective"], mask=mask, normal=normal).write(tmp_path / "solved" / "maps.exr")
    scan, = read(tmp_path, {"name": "a", "path": "a/depth.exr", "maps": "solved"})
    assert scan.maps == tmp_path / "solved" / "maps.exr" and scan.colours is None


@pytest.mark.parametrize(("entry", "sentence"), [
    ({"path": "nothing"}, "is neither a folder with a depth.exr nor a PLY file"),
    ({"path": "a", "unit": "mm"}, "unit: is mm, but depth.exr is in metres"),
    ({"path": "a", "maps": "solved"}, "is not there: run `relit solve` first"),
    ({"path": "dot.ply"}, "sigma_m: is missing, and 1 points are too few"),
    ({"path": "dot.ply", "maps": "solved"}, "solved maps belong to a range image"),
])
def test_what_is_no_scan_is_refused_with_a_sentence(tmp_path, entry, sentence):
    write(tmp_path, "a")
    write_ply(PointCloud(np.zeros((1, 3), dtype=np.float32), np.zeros((1, 3), dtype=np.uint8)), tmp_path / "dot.ply")
    with pytest.raises(StageError, match=sentence):
        read(tmp_path, {"name": "x", **entry})


def test_a_depth_without_sigma_has_one_that_is_estimated(tmp_path):
    write(tmp_path, "a", sigma=False, noise=1e-3)
    scan, = read(tmp_path, {"name": "a", "path": "a"})
    assert scan.sigma_source == "estimated" and 5e-4 < scan.sigma[0] < 3e-3
    write(tmp_path, "empty")
    depths = DepthMaps.read(tmp_path / "empty" / "depth.exr")
    depths.mask[:] = False
    depths.write(tmp_path / "empty" / "depth.exr")
    with pytest.raises(ManifestError, match=r"scans\[0\] \(e\): no pixel of .* has a depth with a σ"):
        read(tmp_path, {"name": "e", "path": "empty"})
