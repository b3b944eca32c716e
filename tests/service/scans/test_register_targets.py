"""relit register with named targets in scan-set.json: a vase is placed, and a target that moved is told by its name."""

import json
from functools import cache

import numpy as np
import pytest

from service.scans.points.rigid import applied, inverse, step_between
from service.scans.points.scan import Scan
from stage.formats.images import write_png
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import read_scan_set
from tests.scenes.turntable import MM, View, turntable, vase
from tests.service.scans.registration.test_found_targets import CAMERA, POSES, look
from tests.service.scans.test_register import off, write

PLACES = {f"T{k}": np.array(place) for k, place in enumerate(
    [(0.4, -0.4, 0), (0.2, 0.3, 0.4), (-0.2, -0.4, 0.4), (-0.4, 0.2, -0.1), (0, 0.4, -0.4)])}


@cache
def views() -> tuple[View, ...]:
    return tuple(turntable(vase, [0, 60, 130], rows=80))


def targets(**changed: np.ndarray) -> dict:
    """The targets of each scan; `changed` are other places in the last."""
    out = {}
    for number, view in enumerate(views()):
        rng = np.random.default_rng(number)
        places = {**PLACES, **(changed if number == 2 else {})}
        out[f"s{number}"] = {"targets": [
            {"name": name, "sigma_m": 1e-4,
             "position_m": (applied(inverse(view.world_from_scan), place[None])[0] + 1e-4 * rng.standard_normal(3)).tolist()}
            for name, place in places.items()]}
    return out


def test_a_vase_is_placed_by_targets_and_one_that_moved_is_named(relit, tmp_path):
    folder = write(tmp_path / "set", views(), **targets(T1=PLACES["T1"] + [0, 0.003, 0]))
    outcome = relit.done("register", folder, "--out", tmp_path / "out")
    assert max(shift for shift, _ in off(tmp_path / "out", views()).values()) < 0.5 * MM  # five σ of targets of .1 mm half a metre away
    assert "target T1: in s2 it lies 3" in outcome.err + outcome.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert {pair["by"] for pair in report["pairs"] if pair["state"] == "joined"} == {"targets"}
    place, = (place for place in report["targets"] if place["name"] == "T1")
    assert place["scans"] == ["s0", "s1"] and place["elsewhere"]["s2"] == pytest.approx(0.003, abs=5e-4)
    written = json.loads((tmp_path / "out" / "scan-set.json").read_text())
    assert [target["name"] for target in written["scans"][1]["targets"]] == list(PLACES)


@pytest.mark.parametrize(("target", "words"), [
    ({"name": "T0", "position_m": [0, 0, 1]}, "scans[0].targets[0].sigma_m"),
    ({"name": "T0", "position_m": [0, 0], "sigma_m": 1e-4}, "scans[0].targets[0].position_m"),
    ({"name": "T0", "position_m": [0, 0, 1], "sigma_m": 0}, "scans[0].targets[0].sigma_m"),
])
def test_bad_targets_are_refused_by_their_field(relit, tmp_path, target, words):
    relit("register", write(tmp_path / "set", views(), s0={"targets": [target]}), "--out", tmp_path / "out").refused(words)
    assert not (tmp_path / "out").exists()


def test_a_target_is_listed_once(relit, tmp_path):
    one = {"name": "T0", "position_m": [0, 0, 1], "sigma_m": 1e-4}
    relit("register", write(tmp_path / "set", views(), s0={"targets": [one, one]}), "--out", tmp_path / "out").refused("T0 is there twice")


@cache
def looks(kind: str) -> list[tuple[np.ndarray, Scan]]:
    return [look(kind, pose, seed=number) for number, pose in enumerate(POSES)]


def write_walls(folder, kind: str, *, images: bool = True):
    """Range images of a flat wall with marks, and photographs of it by the same camera; one pixel in nine has a depth."""
    entries = []
    for number, (image, scan) in enumerate(looks(kind)):
        depth = np.zeros(image.shape, dtype=np.float32)
        depth[::3, ::3] = scan.image(-scan.points[:, 2])[::3, ::3]
        DepthMaps(camera=CAMERA, mask=depth > 0, depth=depth, sigma=np.full(depth.shape, 2e-4, dtype=np.float32)).write(
            folder / f"s{number}" / "depth.exr")
        codes = np.rint(255 * np.clip(np.sqrt(image), 0, 1)).astype(np.uint8)
        write_png(folder / f"s{number}.png", codes[..., None].repeat(3, 2), srgb=True)
        entries.append({"name": f"s{number}", "path": f"s{number}", **({"image": f"s{number}.png"} if images else {})})
    (folder / "scan-set.json").write_text(json.dumps({"schema": "relit.scan-set/1", "name": "wall", "scans": entries}))
    return folder


@pytest.mark.long
@pytest.mark.parametrize(("kind", "option"), [
    ("aruco4", ("--markers", "aruco4")), ("board", ("--board", "7x6"))])
def test_a_flat_wall_is_placed_by_the_marks_that_its_images_show(relit, tmp_path, kind, option):
    folder = write_walls(tmp_path / "set", kind)
    relit.done("register", folder, "--out", tmp_path / "out", *option)
    _, found = read_scan_set(tmp_path / "out")
    world = np.array(found.scans[0].scan_to_world) @ inverse(POSES[0])
    for entry, pose in zip(found.scans, POSES, strict=True):
        step = step_between(inverse(world) @ np.array(entry.scan_to_world) @ inverse(pose), np.zeros(3))
        assert np.linalg.norm(step[3:]) < 5e-4 and np.degrees(np.linalg.norm(step[:3])) < 0.15  # marks of a fifth of a pixel of 2 mm
    assert (tmp_path / "out" / str(found.scans[1].image)).is_file()


@pytest.mark.long
def test_marks_that_no_image_shows_and_boards_without_ends_are_refused(relit, tmp_path):
    folder = write_walls(tmp_path / "set", "aruco4")
    for option, words in ((("--markers", "aruco7"), "--markers aruco7: no scan shows any"), (("--board", "6"), "give two whole numbers"),
                          (("--board", "7x7"), "looks the same from both ends")):
        assert words in relit.refused("register", folder, "--out", tmp_path / "out", *option) and not (tmp_path / "out").exists()
    outcome = relit("register", write_walls(tmp_path / "plain", "aruco4", images=False), "--out", tmp_path / "out", "--markers", "aruco4")
    assert outcome.code == 2 and "has neither an image nor colours" in outcome.err
