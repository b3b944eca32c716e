"""relit import scans: frames of a depth camera, as several benchmarks publish them, become range images with their poses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stage.formats.ply import read_ply
from stage.importers.depth_frames import frame_layout
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import read_scan_set
from tests.scenes.turntable import View, figure, turntable


@pytest.fixture(scope="module")
def views() -> list[View]:
    return turntable(figure, [0.0, 40.0], rows=96)


def opencv_pose(view: View) -> np.ndarray:
    return view.world_from_scan @ np.diag([1.0, -1, -1, 1])


def centred(view: View) -> list[float]:
    """fx, fy, cx, cy with whole numbers at the centres of pixels."""
    height, width = view.mask.shape
    return [*view.camera.focal_px, width / 2 - 0.5, height / 2 - 0.5]


def write_images(folder: Path, views: list[View], depths: list[str], colours: list[str], units: float) -> None:
    for number, view in enumerate(views):
        for name in (depths[number], colours[number]):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / depths[number]), np.where(view.mask, units * view.true_depth, 0).round().astype(np.uint16))
        cv2.imwrite(str(folder / colours[number]), np.full((*view.mask.shape, 3), (30, 60, 40 + 100 * number), np.uint8))


def check(folder: Path, views: list[View], rounded_m: float) -> None:
    scans = json.loads((folder / "scan-set.json").read_text())["scans"]
    assert len(scans) == len(views)
    for number, (entry, view) in enumerate(zip(scans, views, strict=True)):
        assert np.array(entry["scan_to_world"]) == pytest.approx(view.world_from_scan, abs=1e-6)
        depth = DepthMaps.read(folder / entry["path"] / "depth.exr")
        assert np.abs(depth.depth - view.true_depth)[depth.mask].max() < rounded_m
        points, truth = depth.camera.points(-depth.depth), view.camera.points(-view.true_depth)
        assert np.abs(points - truth)[depth.mask].max() < 2 * rounded_m
        colours = read_ply(folder / entry["path"] / "points.ply").colours
        assert np.abs(colours.astype(int) - (40 + 100 * number, 60, 30)).max() <= 3  # JPEG


def test_frames_of_tum(relit, tmp_path, views):
    """Images and poses whose times differ by some milliseconds, depths of 1/5000 m, and intrinsics that no file says."""
    folder = tmp_path / "desk"
    folder.mkdir()
    write_images(folder, views, ["depth/10.030.png", "depth/10.064.png"], ["rgb/10.035.png", "rgb/10.070.png"], 5000)
    (folder / "depth.txt").write_text("# depth maps\n10.030 depth/10.030.png\n10.064 depth/10.064.png\n")
    (folder / "rgb.txt").write_text("# colour images\n9.9 rgb/lost.png\n10.035 rgb/10.035.png\n10.070 rgb/10.070.png\n")
    rows = []
    for time, view in zip((10.033, 10.060), views, strict=True):
        pose = opencv_pose(view)
        rows.append([time, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()])
    lines = [" ".join(map(str, row)) for row in [[10.0, 9, 9, 9, 0, 0, 0, 1], *rows, [10.09, 9, 9, 9, 0, 0, 0, 1]]]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    guessed = relit.done("import", "guess", folder).out
    assert "TUM" in guessed and f"relit import scans {folder} SCAN_SET --intrinsics FX,FY,CX,CY" in guessed
    assert "give --intrinsics FX,FY,CX,CY" in relit.refused("import", "scans", folder, tmp_path / "none")
    said = relit.done("import", "scans", folder, tmp_path / "set", "--intrinsics", ",".join(map(str, centred(views[0])))).out
    assert "0.0002 m a unit" in said and "2 of 2" in said
    check(tmp_path / "set", views, 0.00011)  # half of 1/5000 m is rounded
    (folder / "groundtruth.txt").write_text("\n".join(lines[:2]))
    relit.done("import", "scans", folder, tmp_path / "one", "--intrinsics", "500,500,60,48")
    scans = json.loads((tmp_path / "one" / "scan-set.json").read_text())["scans"]
    assert ["scan_to_world" in entry for entry in scans] == [True, False]  # the second is 31 ms from any pose
    (folder / "groundtruth.txt").write_text("10.03 0 0 0 0 0 0 2\n")
    given = ["--intrinsics", "500,500,60,48"]
    assert "groundtruth.txt" in relit.refused("import", "scans", folder, tmp_path / "bad", *given)
    (folder / "groundtruth.txt").unlink()
    (folder / "depth.txt").write_text("10.030 depth/10.030.png\n10.064 depth/10.064.png\n10.1 depth/lost.png\n")
    assert "depth/lost.png: is not there" in relit.refused("import", "scans", folder, tmp_path / "bad", *given)
    (folder / "depth.txt").write_text("10.030 depth/10.030.png\n10.064 rgb/../depth/10.030.png\n")
    assert "two depth images are named 10.030" in relit.refused("import", "scans", folder, tmp_path / "bad", *given)
    (folder / "depth.txt").write_text("10.030 depth/10.030.png\n10.064 depth/10.064.png\n")
    table = ["--axis", "0,1,0", "--axis-point", "0,0,0", "--turntable", "0,1,2"]
    assert "2 scans, and --turntable 3 angles" in relit.refused("import", "scans", folder, tmp_path / "bad", *given, *table)
    assert "take no --unit" in relit.refused("import", "scans", folder, tmp_path / "bad", *given, "--unit", "mm")
    assert not (tmp_path / "bad").exists()


def test_frames_of_redwood(relit, tmp_path, views):
    """Millimetres, a trajectory that counts images from 1 in another order, and the JSON of Open3D, whose matrix goes by columns."""
    folder = tmp_path / "room"
    folder.mkdir()
    write_images(folder, views, ["depth/00000.png", "depth/00001.png"], ["image/00000.jpg", "image/00001.jpg"], 1000)
    fx, fy, cx, cy = centred(views[0])
    height, width = views[0].mask.shape
    (folder / "camera.json").write_text(json.dumps({"width": width, "height": height,
                                                    "intrinsic_matrix": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}))
    blocks = [f"{number} {number} {number + 1}\n" + "\n".join(" ".join(map(str, row)) for row in opencv_pose(views[number]))
              for number in (1, 0)]
    (folder / "trajectory.log").write_text("\n".join(blocks) + "\n")
    (folder / "odometry.log").write_text("another\n")
    guessed = relit.done("import", "guess", folder).out
    assert "Redwood" in guessed and "--intrinsics" not in guessed
    relit.done("import", "scans", folder, tmp_path / "set")
    check(tmp_path / "set", views, 0.0006)  # half a millimetre is rounded
    (folder / "trajectory.log").write_text(blocks[0] + "\n" + blocks[0])
    assert "each once" in relit.refused("import", "scans", folder, tmp_path / "twice")
    (folder / "trajectory.log").write_text(blocks[0] + " 5\n")
    assert "trajectory.log" in relit.refused("import", "scans", folder, tmp_path / "bad")
    (folder / "camera.json").write_text(json.dumps({"intrinsic_matrix": [fx, 0, cx, 0, fy, cy, 0, 0, 1]}))
    assert "the columns of the matrix" in relit.refused("import", "scans", folder, tmp_path / "rows")


def test_frames_of_a_depth_camera(relit, tmp_path, views):
    """Millimetres, edges that are left out, and poses in the axes of OpenCV, a little off a rotation."""
    folder = tmp_path / "frames"
    folder.mkdir()
    focal = views[0].camera.focal_px[0]
    height, width = views[0].mask.shape
    (folder / "camera-intrinsics.txt").write_text(f"{focal} 0 {width / 2 - 0.5}\n0 {focal} {height / 2 - 0.5}\n0 0 1\n")
    for number, view in enumerate(views[:2]):
        cv2.imwrite(str(folder / f"f{number}.depth.png"), np.where(view.mask, 1000 * view.true_depth, 0).round().astype(np.uint16))
        pose = view.world_from_scan @ np.diag([1.0, -1, -1, 1])
        pose[:3, :3] *= 1 + 1e-4
        np.savetxt(folder / f"f{number}.pose.txt", pose)
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    assert "2 depth images" in said and "nearest" in said
    scans = json.loads((tmp_path / "set" / "scan-set.json").read_text())["scans"]
    for entry, view in zip(scans, views, strict=False):
        assert np.array(entry["scan_to_world"]) == pytest.approx(view.world_from_scan, abs=1e-6)
        depth = DepthMaps.read(tmp_path / "set" / entry["path"] / "depth.exr")
        assert np.abs(depth.depth - view.true_depth)[depth.mask].max() < 0.0006  # half a millimetre is rounded
        assert 0.3 < depth.mask.sum() / view.mask.sum() < 1 and not depth.mask[~view.mask].any()
        points, truth = depth.camera.points(-depth.depth), view.camera.points(-view.true_depth)
        assert np.abs(points - truth)[depth.mask].max() < 0.001
    assert "depth images are converted" in relit.refused("import", "scans", folder)
    np.savetxt(folder / "f1.pose.txt", np.diag([1.001, 1, 1, 1]))
    assert "f1.depth.png: its pose is not a rotation" in relit.refused("import", "scans", folder, tmp_path / "stretched")
    (folder / "camera-intrinsics.txt").write_text("1 2 3")
    assert "camera-intrinsics.txt" in relit.refused("import", "scans", folder, tmp_path / "other")


def test_a_turntable_of_depth_results_is_written_by_options(relit, tmp_path, views):
    """The set stands beside the results; the poses of its table are those of the views, whose object turned about +y before the camera."""
    source = tmp_path / "results"
    for number, view in enumerate(views):
        DepthMaps(camera=view.camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(source / f"view{9 + number}" / "depth.exr")
    point = np.linalg.inv(views[0].world_from_scan)[:3, 3]
    axis = np.linalg.inv(views[0].world_from_scan)[:3, 1]
    table = ["--axis", ",".join(map(str, axis)), "--axis-point", ",".join(map(str, point))]
    assert "2 folders with a depth.exr" in relit.done("import", "guess", source).out
    said = relit.done("import", "scans", source, tmp_path / "set", "--turntable", "40", *table).out
    assert "view9 0, view10 40 degrees" in said
    file, scans = read_scan_set(tmp_path / "set")
    assert [(file.parent / scan.path).resolve() for scan in scans.scans] == [source / "view9", source / "view10"]
    assert scans.turntable is not None and scans.turntable.angles_deg is not None
    truth = np.linalg.inv(views[0].world_from_scan) @ views[1].world_from_scan
    assert scans.turntable.pose_at(scans.turntable.angles_deg[1]) == pytest.approx(truth, abs=1e-9)
    relit.done("import", "scans", source, tmp_path / "open", *table)
    assert read_scan_set(tmp_path / "open")[1].turntable.angles_deg is None
    assert "3 angles" in relit.refused("import", "scans", source, tmp_path / "bad", "--turntable", "0,1,2", *table)
    assert "axis" in relit.refused("import", "scans", source, tmp_path / "bad", "--turntable", "40")
    wrong = ["--unit", "mm", "--every", "2"]
    assert "take no --unit and no --every" in relit.refused("import", "scans", source, tmp_path / "bad", *wrong)


def test_a_list_without_depth_images_is_no_depth_camera(tmp_path):
    (tmp_path / "depth.txt").write_text("3 m of water\n")
    (tmp_path / "1.png").write_bytes(b"")
    assert frame_layout(tmp_path) is None
