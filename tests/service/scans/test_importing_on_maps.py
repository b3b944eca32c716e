"""relit import scans: PLY files whose points lie far from their origin, as in coordinates of a map."""

import json
from pathlib import Path

import numpy as np
import pytest

from service.scans.points.ply_points import PlyPoints, read_ply_points

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
