"""relit import scans: files whose points or poses lie far from their origin, as in coordinates of a map, and poses that say nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.scans.points.ply_points import PlyPoints, read_ply_points
from tests.marks import first_short

MAP = np.array([450123.0, 5201234.0, 431.0])
POINTS = np.rint(2**13 * np.random.default_rng(3).uniform(0, 1, (400, 3)) * [1, 0.7, 0.05]) / 2**13
"""A slab of a metre, whose points floats of 32 bits hold at 512 m too."""
NORMAL, SIGMA, COLOUR = [0.0, 0.6, 0.8], 2e-4, [200, 100, 50]


def write(path: Path, points: np.ndarray, kind: str) -> None:
    path.parent.mkdir(exist_ok=True)
    names = {**dict.fromkeys(("x", "y", "z"), kind), **dict.fromkeys(("nx", "ny", "nz", "sigma"), "float"),
             **dict.fromkeys(("red", "green", "blue"), "uchar")}
    types = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    values = np.zeros(len(points), [(name, types[each]) for name, each in names.items()])
    for name, column in zip(names, [*points.T, *NORMAL, SIGMA, *COLOUR], strict=True):
        values[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}",
            *(f"property {each} {name}" for name, each in names.items()), "end_header\n"]
    path.write_bytes("\n".join(head).encode() + values.tobytes())


def imported(relit, folder: Path) -> tuple[str, list[PlyPoints], list[dict]]:
    said = relit.done("import", "scans", folder, folder.parent / "set").out
    entries = json.loads((folder.parent / "set" / "scan-set.json").read_text())["scans"]
    return said, [read_ply_points(folder.parent / "set" / entry["path"]) for entry in entries], entries


def test_doubles_on_a_map_are_counted_from_among_them(relit, tmp_path):
    for number in range(2):
        write(tmp_path / "scans" / f"s{number}.ply", MAP + number + POINTS, "double")
    said, clouds, _ = imported(relit, tmp_path / "scans")
    moved = np.array([float(value) for value in said.split("is moved to ")[1].split()[0].split(",")])
    for number, cloud in enumerate(clouds):
        assert cloud.points + (moved - MAP) == pytest.approx(POINTS + number, abs=1e-6)  # floats of 32 bits of a few metres
        assert cloud.sigma == pytest.approx(SIGMA) and cloud.normals is not None and cloud.colours is not None
        assert cloud.normals[0] == pytest.approx(NORMAL) and cloud.colours[0].tolist() == COLOUR
    assert "warning" not in said
    assert "give another folder" in relit.refused("import", "scans", tmp_path / "scans", tmp_path / "scans")


@pytest.mark.parametrize(("kind", "origin"), [("double", 0.0), ("float", 0.0), ("float", 512.0)])
def test_files_whose_numbers_are_fine_enough_stay_as_they_are(relit, tmp_path, kind, origin):
    write(tmp_path / "scans" / "a.ply", origin + POINTS, kind)
    said, _, entries = imported(relit, tmp_path / "scans")
    assert "moved" not in said and "warning" not in said
    assert (tmp_path / "set" / "a.ply").read_bytes() == (tmp_path / "scans" / "a.ply").read_bytes()
    others = tmp_path / "near" / "scans"
    others.parent.mkdir()
    write(others / "a.ply", POINTS, kind)
    near = imported(relit, others)[2]
    assert np.array(entries[0]["viewpoint_m"]) - origin == pytest.approx(near[0]["viewpoint_m"], abs=2e-4)  # of a metre, rounded


def test_floats_that_do_not_hold_the_points_are_said(relit, tmp_path):
    write(tmp_path / "scans" / "a.ply", MAP + POINTS, "float")
    assert "a lies so far from the origin that floats of 32 bits" in imported(relit, tmp_path / "scans")[0]


def write_ptx(path: Path, points: np.ndarray, pose: np.ndarray) -> None:
    rows = [pose[:3, 3], *pose[:3, :3].T, *pose.T, *np.column_stack([points, np.full(len(points), 0.5)])]
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{len(points)}\n1\n" + "".join(" ".join(f"{x:.9f}" for x in row) + "\n" for row in rows))


def cap(place: np.ndarray) -> np.ndarray:
    """[n, 3]: what a scanner at a place sees of a ball of a metre, world."""
    points = np.random.default_rng(5).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points[points @ place > 1]


def stations() -> list[np.ndarray]:
    """World from scan of scanners at 9 m around the ball, each turned otherwise."""
    poses = []
    for degrees in (0, 120, 240):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("zyx", [degrees, 20, 10], degrees=True).as_matrix()
        pose[:3, 3] = 9 * Rotation.from_euler("y", degrees, degrees=True).as_matrix()[:, 2]
        poses.append(pose)
    return poses


def placed(folder: Path, entries: list[dict]) -> list[np.ndarray]:
    """The points of each scan in the world."""
    poses = [np.array(entry["scan_to_world"]) for entry in entries]
    clouds = [read_ply_points(folder / entry["path"]).points for entry in entries]
    return [points @ pose[:3, :3].T + pose[:3, 3] for points, pose in zip(clouds, poses, strict=True)]


@first_short("applied", [False, True], ids=["poses", "points"])
def test_scans_with_poses_on_a_map_are_counted_from_among_their_places(relit, tmp_path, applied):
    """In the frames of the scanners, or with the poses applied already: a mesh has floats of 32 bits."""
    for number, pose in enumerate(stations()):
        world = cap(pose[:3, 3])
        on_map = pose.copy()
        on_map[:3, 3] += MAP
        points = world + MAP if applied else (world - pose[:3, 3]) @ pose[:3, :3]
        write_ptx(tmp_path / "scans" / f"s{number}.ptx", points, np.eye(4) if applied else on_map)
    said, _, entries = imported(relit, tmp_path / "scans")
    moved = np.array([float(value) for value in said.split("is moved to ")[1].split()[0].split(",")])
    for pose, points, entry in zip(stations(), placed(tmp_path / "set", entries), entries, strict=True):
        assert points + (moved - MAP) == pytest.approx(cap(pose[:3, 3]), abs=2e-6)  # floats of 32 bits of some metres, nine digits of turns
        there = np.array(entry["viewpoint_m"])
        assert applied or not there.any()
        towards = np.array(entry["scan_to_world"])[:3] @ [*there, 1] + (moved - MAP)
        assert towards @ pose[:3, 3] > 0.8 * np.linalg.norm(towards) * 9  # where it is estimated, to some tens of degrees
    assert "warning" not in said


@first_short("applied", [False, True], ids=["frames of scanners", "one frame"])
def test_poses_that_are_all_the_identity_do_not_put_scanners_at_the_origin(relit, tmp_path, applied):
    """Programs write such poses for scans that lie in one frame; the origin is within the ball."""
    for number, pose in enumerate(stations()):
        world = cap(pose[:3, 3])
        write_ptx(tmp_path / "scans" / f"s{number}.ptx", world if applied else (world - pose[:3, 3]) @ pose[:3, :3], np.eye(4))
    said, _, entries = imported(relit, tmp_path / "scans")
    assert ("do not look seen from their origin" in said) is applied and ("viewpoint as the files say" in said) is not applied
    for pose, entry in zip(stations(), entries, strict=True):
        there = np.array(entry["viewpoint_m"])
        assert there @ pose[:3, 3] > 0.8 * np.linalg.norm(there) * 9 if applied else not there.any()


def test_files_of_other_kinds_whose_numbers_were_floats_are_said(relit, tmp_path):
    (tmp_path / "scans").mkdir()
    np.savetxt(tmp_path / "scans" / "a.xyz", (MAP + POINTS).astype(np.float32), fmt="%.9g")
    assert "a lies so far from the origin that floats of 32 bits hold its points to 0.5 m only" in imported(relit, tmp_path / "scans")[0]
