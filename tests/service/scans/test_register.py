"""relit register: scans of a simulated figure come together, how sure their poses are, and what is refused or flagged with a sentence."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from service.scans.points.rigid import inverse, step_between
from stage.formats.ply import PointCloud, write_ply
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import read_scan_set
from stage.transforms import rotation_about
from tests.scenes.turntable import DISTANCE_M, MM, Distance, View, figure, pose, turntable, urn, vase

ROWS = 120
"""Pixels of 10 mm on the figure: the search must do with some 2500 points a scan."""


@cache
def views(surface: Distance, *angles: float) -> tuple[View, ...]:
    return tuple(turntable(surface, list(angles), rows=ROWS))


def write(folder: Path, seen: tuple[View, ...], **entries: dict) -> Path:
    """A scan set; `entries` are further keys of the scans s0, s1 …, among them `points`, which changes them and makes a PLY file."""
    folder.mkdir(parents=True, exist_ok=True)
    scans = []
    for number, view in enumerate(seen):
        name = f"s{number}"
        further = dict(entries.get(name, {}))
        change = further.pop("points", None)
        path = name
        if change is None:
            DepthMaps(camera=view.camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(folder / name / "depth.exr")
        else:
            path = f"{name}.ply"
            points = change(view.camera.points(-view.depth)[view.mask].astype(float))
            write_ply(PointCloud(points.astype(np.float32), np.zeros((len(points), 3), dtype=np.uint8)), folder / path)
        scans.append({"name": name, "path": path, **further})
    data = {"schema": "relit.scan-set/1", "name": "figure", "scans": scans, **entries.get("top", {})}
    (folder / "scan-set.json").write_text(json.dumps(data))
    return folder


def off(folder: Path, seen: tuple[View, ...]) -> dict[str, tuple[float, float]]:
    """By how much each pose is wrong against the first: metres at the middle of the figure, and degrees."""
    _, found = read_scan_set(folder)
    first = found.scans[0]
    assert first.scan_to_world is not None
    world = np.array(first.scan_to_world) @ inverse(seen[0].world_from_scan)
    out = {}
    for entry, view in zip(found.scans, seen, strict=True):
        if entry.scan_to_world is not None:
            step = step_between(inverse(world) @ np.array(entry.scan_to_world) @ inverse(view.world_from_scan), np.zeros(3))
            out[entry.name] = float(np.linalg.norm(step[3:])), float(np.degrees(np.linalg.norm(step[:3])))
    return out


def table_of(seen: tuple[View, ...], *angles: float, **further) -> dict:
    """The turntable in the frame of the camera, whose axis is +y of the figure's world."""
    camera = inverse(pose(0.0))
    return {"turntable": {"axis_point_m": camera[:3, 3].tolist(), "axis": (camera[:3, :3] @ [0, 1, 0]).tolist(), "angles_deg": list(angles),
                          **further}}


@pytest.mark.long
def test_scans_without_poses_come_together(relit, tmp_path):
    seen = views(figure, 0, 30, 60, 100, 150)
    outcome = relit.done("register", write(tmp_path / "set", seen), "--out", tmp_path / "out")
    assert "joined   5 of 5 scans" in outcome.out
    wrong = off(tmp_path / "out", seen)
    assert len(wrong) == 5
    assert max(shift for shift, _ in wrong.values()) < 0.3 * MM and max(turn for _, turn in wrong.values()) < 0.1
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    for entry in report["scans"]:  # five standard deviations of three numbers each
        shift, turn = wrong[entry["name"]]
        assert shift < 5 * entry["pose_sigma_m"] + 1e-9 and turn < 5 * entry["pose_sigma_degrees"] + 1e-9
    states = {tuple(pair["scans"]): pair["state"] for pair in report["pairs"]}
    assert states["s0", "s1"] == "joined" and states["s0", "s4"] != "joined" and len(states) == 10
    _, found = read_scan_set(tmp_path / "out")
    assert (tmp_path / "out" / found.scans[0].path / "depth.exr").is_file()
    assert np.array(found.scans[0].pose_covariance).max() == 0 and np.array(found.scans[1].pose_covariance).max() > 0


@pytest.mark.long
def test_a_scan_that_is_there_twice_counts_once(relit, tmp_path):
    """The others' poses are to the last bit what they are without it, and so is how sure they are."""
    seen = views(figure, 0, 30, 60)
    relit("register", write(tmp_path / "set", seen), "--out", tmp_path / "out")
    folder = write(tmp_path / "twice", (*seen[:2], seen[1], seen[2]))
    data = json.loads((folder / "scan-set.json").read_text())
    outcome = relit("register", folder, "--out", tmp_path / "found", "--reference", "s0")
    assert outcome.code == 0 and "s2: holds no points but those of s1, and counts once" in outcome.out + outcome.err
    assert "joined   3 of 3 scans" in outcome.out
    assert json.loads((tmp_path / "found" / "report.json").read_text())["duplicates"] == {"s2": "s1"}
    once, twice = (read_scan_set(tmp_path / name)[1].scans for name in ("out", "found"))
    assert [entry.name for entry in twice] == [scan["name"] for scan in data["scans"]]
    for here, there in ((0, 0), (1, 1), (1, 2), (2, 3)):
        assert once[here].scan_to_world == twice[there].scan_to_world and once[here].pose_covariance == twice[there].pose_covariance
    refused = relit.refused("register", write(tmp_path / "one", (seen[0], seen[0])), "--out", tmp_path / "none")
    assert "holds one scan" in refused and "s1: holds no points but those of s0" in refused


@pytest.mark.long
def test_poses_of_the_file_are_starts(relit, tmp_path):
    seen = views(figure, 0, 30, 60)
    rough = {}
    for number, view in enumerate(seen):
        start = view.world_from_scan @ np.eye(4)
        start[:3, 3] += 8 * MM * (number > 0)
        rough[f"s{number}"] = {"scan_to_world": start.tolist()}
    relit.done("register", write(tmp_path / "set", seen, **rough), "--out", tmp_path / "out")
    assert max(shift for shift, _ in off(tmp_path / "out", seen).values()) < 0.2 * MM
    _, found = read_scan_set(tmp_path / "out")
    np.testing.assert_allclose(found.scans[0].scan_to_world, seen[0].world_from_scan, atol=1e-12)  # the reference stays where it is


@pytest.mark.long
def test_starts_decide_where_the_surface_does_not(relit, tmp_path):
    """About its axis a vase stays at its start, half a degree off, and σ says that; elsewhere its surface places it.

    The direction that is open is found from noisy normals, so that a fifth of a degree of the fit's own way is left.
    """
    seen = views(vase, 0, 30)
    turn = rotation_about((0.0, 1.0, 0.0), 0.5)
    poses = [view.world_from_scan @ np.eye(4) for view in seen]
    poses[1][:3] = turn @ poses[1][:3]
    poses[1][1, 3] += 3 * MM
    folder = write(tmp_path / "set", seen, **{f"s{number}": {"scan_to_world": each.tolist()} for number, each in enumerate(poses)})
    relit.refused("register", folder, "--out", tmp_path / "none")
    outcome = relit("register", folder, "--out", tmp_path / "out", "--starts")
    assert outcome.code == 0 and "its start is taken there" in outcome.out + outcome.err
    shift, degrees = off(tmp_path / "out", seen)["s1"]
    assert degrees == pytest.approx(0.5, abs=0.2) and shift < 0.5 * MM
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    points = seen[1].camera.points(-seen[1].depth)[seen[1].mask] - [0, 0, -DISTANCE_M]
    reach = np.sqrt((points**2).sum(axis=1).mean() - points[:, 1].mean() ** 2)  # from the axis at the height of their middle
    assert report["scans"][1]["pose_sigma_degrees"] == pytest.approx(np.degrees(report["cell_m"] / reach), rel=0.05)  # of thinned points
    data = json.loads((folder / "scan-set.json").read_text())
    for scan in data["scans"]:
        del scan["scan_to_world"]
    (folder / "scan-set.json").write_text(json.dumps(data))
    empty = DepthMaps(camera=seen[0].camera, mask=np.zeros_like(seen[0].mask), depth=seen[0].depth)
    empty.write(folder / "s0" / "depth.exr")  # it is said before the scans are read
    assert "has no two scans with a pose" in relit.refused("register", folder, "--out", tmp_path / "no", "--starts")


@pytest.mark.long
def test_wrong_depths_do_not_refuse_a_start_that_decides(relit, tmp_path):
    """A disc of the surface is measured 40 mm before itself, as in folds that light bounces in: 2 % of the pixels of a scan."""
    seen = list(views(figure, 0, 30))
    row, column = np.argwhere(seen[1].mask).mean(axis=0)
    rows, cols = np.indices(seen[1].mask.shape)
    disc = seen[1].mask & (np.hypot(rows - row, cols - column) < np.sqrt(0.02 * seen[1].mask.sum() / np.pi))
    seen[1] = seen[1]._replace(depth=np.where(disc, seen[1].depth - 40 * MM, seen[1].depth).astype(np.float32))
    poses = [view.world_from_scan @ np.eye(4) for view in seen]
    poses[1][:3, 3] += 8 * MM
    folder = write(tmp_path / "set", tuple(seen), **{f"s{number}": {"scan_to_world": each.tolist()} for number, each in enumerate(poses)})
    assert "saw through: --starts" in relit.refused("register", folder, "--out", tmp_path / "none")
    outcome = relit("register", folder, "--out", tmp_path / "out", "--starts")
    assert outcome.code == 0 and "depths there are wrong" in outcome.out + outcome.err
    shift, degrees = off(tmp_path / "out", tuple(seen))["s1"]
    assert shift < 0.2 * MM and degrees < 0.1  # a fiftieth of a pixel, as of the scans without the disc
    poses[1][:3] = rotation_about((0.0, 1.0, 0.0), 90.0) @ poses[1][:3]
    folder = write(tmp_path / "set", tuple(seen), **{f"s{number}": {"scan_to_world": each.tolist()} for number, each in enumerate(poses)})
    relit.refused("register", folder, "--out", tmp_path / "turned", "--starts")


@pytest.mark.long
@pytest.mark.parametrize("given", [(0.0, 29.0, 61.0), None], ids=["rough angles", "no angles"])
def test_the_angles_of_a_turntable_are_refined(relit, tmp_path, given):
    seen = views(figure, 0, 30, 60)
    table = table_of(seen, *(given or ()))
    if given is None:
        del table["turntable"]["angles_deg"]
    relit.done("register", write(tmp_path / "set", seen, top=table), "--out", tmp_path / "out", "--turntable", "angles")
    wrong = off(tmp_path / "out", seen)
    assert max(shift for shift, _ in wrong.values()) < 1e-3 * MM  # the axis holds the middle
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    for entry in report["scans"]:
        turn = wrong[entry["name"]][1]
        assert turn < 0.1 and turn <= 4 * entry["pose_sigma_degrees"] + 1e-9


@pytest.mark.long
def test_a_wrong_axis_of_a_turntable_is_named(relit, tmp_path):
    seen = views(figure, 0, 30, 60)
    table = table_of(seen, 0, 30, 60)
    table["turntable"]["axis_point_m"][0] += 20 * MM  # the loop then leaves a hundred times its noise
    outcome = relit("register", write(tmp_path / "set", seen, top=table), "--out", tmp_path / "out", "--turntable", "angles")
    assert "the axis of the turntable, lenses or σ may be wrong" in outcome.out + outcome.err
    outcome = relit("register", tmp_path / "set", "--out", tmp_path / "free", "--turntable", "start")
    assert "may be wrong" not in outcome.out + outcome.err


@pytest.mark.long
def test_a_fixed_turntable_is_kept_and_checked(relit, tmp_path):
    seen = views(figure, 0, 30, 60)
    folder = write(tmp_path / "set", seen, top=table_of(seen, 0, 30, 60))
    outcome = relit.done("register", folder, "--out", tmp_path / "out", "--turntable", "fixed")
    assert "ask for poses" not in outcome.out + outcome.err
    assert max(shift for shift, _ in off(tmp_path / "out", seen).values()) < 1e-9
    folder = write(tmp_path / "bad", seen, top=table_of(seen, 0, 30, 61))
    outcome = relit.done("register", folder, "--out", tmp_path / "out2", "--turntable", "fixed")
    assert "s1 and s2: their surfaces ask for poses that are" in outcome.out + outcome.err


@pytest.mark.long
def test_a_vase_is_refused_and_placed_by_a_fixed_turntable(relit, tmp_path):
    seen = views(vase, 0, 40, 80)
    outcome = relit("register", write(tmp_path / "set", seen), "--out", tmp_path / "out")
    assert outcome.code == 2 and "the surface looks the same when it is turned about an axis" in outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert {pair["state"] for pair in report["pairs"]} == {"ambiguous"} and not (tmp_path / "out" / "scan-set.json").exists()
    folder = write(tmp_path / "turned", seen, top=table_of(seen, 0, 40, 80))
    outcome = relit.done("register", folder, "--out", tmp_path / "out", "--turntable", "fixed")
    assert "nothing checks the turntable" in outcome.out + outcome.err


@pytest.mark.long
def test_a_body_that_looks_alike_when_it_is_turned_is_named(relit, tmp_path):
    seen = views(urn, 0, 90)
    assert "fits as well when it is turned" in relit.refused("register", write(tmp_path / "set", seen), "--out", tmp_path / "none")
    outcome = relit.done("register", tmp_path / "set", "--out", tmp_path / "out", "--accept", "look-alike")
    assert "s0, s1: look much the same when they are turned about an" in outcome.out + outcome.err
    assert json.loads((tmp_path / "out" / "report.json").read_text())["alike_turned"] == ["s0", "s1"]
    assert json.loads((tmp_path / "out" / "report.json").read_text())["scans"][1]["pose_sigma_degrees"] > 45


@pytest.mark.long
@pytest.mark.parametrize(("change", "sentence"), [
    (lambda points: points * [-1, 1, 1], "s3: has no pose: fits the others if it is mirrored"),
    (lambda points: points * 1000, "the others if its coordinates are multiplied by 0.001, as if"),
    (lambda points: points * 1.01, "s3: is about 0."),
    (lambda points: points[:, [0, 2, 1]] * [1, 1, -1] * [1, 1, 0.3], "s3: has no pose"),
], ids=["mirrored", "millimetres", "one per cent", "squeezed"])
def test_a_scan_that_does_not_belong_is_named(relit, tmp_path, change, sentence):
    seen = views(figure, 0, 30, 60, 45)
    outcome = relit("register", write(tmp_path / "set", seen, s3={"points": change, "sigma_m": 2.5e-4}), "--out", tmp_path / "out")
    assert sentence in outcome.out + outcome.err, outcome.out + outcome.err
    _, found = read_scan_set(tmp_path / "out")
    assert all(entry.scan_to_world is not None for entry in found.scans[:3])
    if "has no pose" in sentence:
        assert outcome.code == 1 and found.scans[3].scan_to_world is None


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda points: np.ones((5000, 3)), "s1: nearly all of its 5000 points lie at one place"),
    (lambda points: points * 1e37, r"scans\[1\] \(s1\): path: s1.ply has a coordinate of .*e\+3[78] m, 1e\+07 m are the most"),
])
@pytest.mark.parametrize("table", ["start", "fixed"])
def test_points_that_are_no_scan_are_refused(relit, tmp_path, change, sentence, table):
    seen = views(figure, 0.0, 30.0)
    folder = write(tmp_path / "in", seen, s1={"points": change, "sigma_m": 0.001}, top=table_of(seen, 0.0, 30.0))
    outcome = relit("register", folder, "--turntable", table, "--out", tmp_path / "out")
    assert outcome.code == 2 and re.search(sentence, outcome.err) and not (tmp_path / "out").exists()


def test_scans_without_overlap_are_refused(relit, tmp_path):
    seen = views(figure, 0, 180)
    said = relit.refused("register", write(tmp_path / "set", seen), "--out", tmp_path / "out")
    why = {scan["name"]: scan["why_not"] for scan in json.loads((tmp_path / "out" / "report.json").read_text())["scans"]}
    assert f"s1: {why['s1']}" in said and not (tmp_path / "out" / "scan-set.json").exists()


@pytest.mark.parametrize(("options", "sentence"), [
    (["--turntable", "fixed"], "has no turntable"), (["--reference", "nobody"], "--reference nobody: is no scan of"),
    (["--turntable", "angles", "--poses", "ignored"], "give one of them"), (["--least-overlap", "0"], "--least-overlap"),
])
def test_options_that_do_not_fit_are_refused(relit, tmp_path, options, sentence):
    assert sentence in relit.refused("register", write(tmp_path / "set", views(figure, 0, 30)), "--out", tmp_path / "out", *options)


def test_a_folder_without_a_scan_set_is_told_what_writes_one(relit, tmp_path):
    assert "holds no scan-set.json: `relit import scans` writes one" in relit.refused("register", tmp_path, "--out", tmp_path / "out")


def test_the_input_is_not_replaced_and_one_scan_is_refused(relit, tmp_path):
    folder = write(tmp_path / "set", views(figure, 0, 30))
    assert "would replace" in relit.refused("register", folder, "--out", folder)
    assert "holds one scan" in relit.refused("register", write(tmp_path / "one", views(figure, 0)), "--out", tmp_path / "out")


def test_without_small_gicp_the_extra_is_named(relit, tmp_path, monkeypatch):
    monkeypatch.setattr("service.scans.register.neighbours_are_installed", lambda: False)
    relit("register", write(tmp_path / "set", views(figure, 0, 30)), "--out", tmp_path / "out").refused("pip install 'relit[scans]'")
