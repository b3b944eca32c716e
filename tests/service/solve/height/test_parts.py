"""relit solve: parts in front of one another, placed in depth by the shadows that they cast."""

import json

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.height.parts import PlacedPart, Placement
from service.solve.solve import solve
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import angles_degrees
from tests.scenes.parts import KINDS, Part, ball_before_body, disc_over_plane, random_layout, shoot, sphere_lights, write_shot

SIDE = 64


def solved(shot, tmp_path, method=Method.ROBUST):
    out = tmp_path / "out"
    solve(SolveRequest(capture=write_shot(tmp_path / "capture", shot), out=out, method=method, device="cpu"))
    return SurfaceMaps.read(out / "maps.exr", unsure=True), json.loads((out / "report.json").read_text())


def step_error(maps, shot):
    """Error of the step from part 1 to part 0, in parts of the object's size."""
    error = [np.median((maps.height - shot.z)[shot.part == part]) for part in (0, 1)]
    points = maps.camera.points(shot.z)[shot.scene.mask]
    return (error[0] - error[1]) / np.ptp(points[:, :2], axis=0).max()


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.1, 0.6])
@pytest.mark.parametrize("distance", [None, 4.0])
def test_a_ball_stands_as_far_before_a_body_as_its_shadows_say(gap, distance, tmp_path):
    """Under lights all around, with 2 % noise. Normals alone put it where its rim meets the body: .15 to .4 of the size too far back.

    Tolerance: two pixels of 1/58 of the size, and three σ.
    """
    shot = shoot(ball_before_body(gap=gap), sphere_lights(48), side=SIDE, across=2.2, distance=distance, noise=0.02)
    maps, report = solved(shot, tmp_path)
    body, ball = report["parts"]
    assert body["status"] == "reference" and ball["status"] == "known" and ball["offset"] > 0.2
    error = step_error(maps, shot)
    assert abs(error) < 0.03 and abs(error) * 2.0 < 3 * ball["sigma"] < 0.4
    assert report["warnings"] == []
    inner = np.hypot(*(np.argwhere(shot.part == 0) - np.argwhere(shot.part == 0).mean(axis=0)).T) < 6
    assert (maps.part[shot.part == 0][inner] == 2).all() and (maps.part == 1).sum() == body["pixels"]


@pytest.mark.long
def test_a_tilted_disc_over_a_plane_has_both_slopes(tmp_path):
    """Half of the slope was lost where outline and axis of tilt are parallel. Robust normals of these matt surfaces are right to 0.02°."""
    shot = shoot(disc_over_plane(), sphere_lights(24, least_z=0.3), side=SIDE, across=2.4)
    maps, report = solved(shot, tmp_path)
    up = maps.camera.points(shot.z)[..., 1]
    for part, slope in ((0, -0.58), (1, 0.0)):
        mine = shot.part == part
        assert np.polyfit(up[mine], maps.height[mine], 1)[0] == pytest.approx(slope, abs=0.005)
    assert abs(step_error(maps, shot)) < 0.02 and report["parts"][1]["status"] == "known"


def test_a_surface_of_which_nothing_is_solved_throws_no_shadow(tmp_path):
    """Lights declared behind the object: but for a pixel or two, by noise, no normal faces the camera."""
    shot = shoot(random_layout("ball", 2).parts, sphere_lights(12, least_z=0.3), side=48, across=2.6, noise=0.1)
    behind = shot.scene._replace(directions=shot.scene.directions * [1, 1, -1])
    write_shot(tmp_path / "capture", shot._replace(scene=behind))
    solve(SolveRequest(capture=tmp_path / "capture", out=tmp_path / "out", method=Method.ROBUST, device="cpu"))
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["pixels"]["ok"] == 0 and "of the shadows" not in " ".join(report["warnings"])


@pytest.mark.long
def test_a_part_whose_shadow_meets_no_other_has_an_unknown_step(tmp_path):
    """A second ball beside the body, so far off that no shadow joins them."""
    parts = [Part((1.7, 0.0, 0.4), (0.4, 0.4, 0.4)), Part((0.0, 0.0, 0.0), (0.7, 0.7, 0.5))]
    shot = shoot(parts, sphere_lights(24, least_z=0.6), side=SIDE, across=4.4)
    _, report = solved(shot, tmp_path)
    assert [part["status"] for part in report["parts"]] == ["reference", "unknown"]
    assert "offset" not in report["parts"][1]
    assert any("step to 1 large part of the object is unknown" in sentence for sentence in report["warnings"])


def test_the_warnings_tell_shadows_that_contradict_each_other_from_none():
    parts = [PlacedPart(900, (9, 9), None, True), PlacedPart(200, (1, 2), None, False, 0.5), PlacedPart(100, (3, 4), None, False)]
    none, contradiction = Placement(np.zeros((1, 1), np.float32), parts).warnings()
    assert "(3, 4)" in none and "no shadow falls across the break" in none
    assert "(1, 2)" in contradiction and "contradict each other by 50%" in contradiction
    assert parts[1].facts()["contradiction"] == 0.5 and "contradiction" not in parts[2].facts()


@pytest.mark.long
@pytest.mark.parametrize("radius", [0.08, 0.11])
def test_a_thin_rod_is_a_part_though_its_normals_turn_everywhere(radius, tmp_path):
    """Three pixels in radius, so that normals turn by 20 to 30° from pixel to pixel. Cut at all of these turns, nothing of it was a part.

    Tolerance: two pixels of 1/58 of the size, and three σ.
    """
    rod = Part((0.05, 0.1, 0.75), (0.5, radius, radius))
    shot = shoot([rod, ball_before_body()[1]], sphere_lights(48), side=SIDE, across=2.2, noise=0.02)
    maps, report = solved(shot, tmp_path)
    assert [part["status"] for part in report["parts"]] == ["reference", "known"]
    assert abs(step_error(maps, shot)) < 0.03 and abs(step_error(maps, shot)) * 2.0 < 3 * report["parts"][1]["sigma"]
    assert 0.9 < report["parts"][1]["pixels"] / (shot.part == 0).sum() < 1.1
    assert report["found"]["unexplained_shadows"] < 0.02


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.75, 1.1])
def test_a_wire_that_loses_its_step_is_named_by_its_shadows(gap, tmp_path):
    """Two pixels thick: no part, so that the height leaves it near the body. Its shadows fall where that height throws none."""
    wire = Part((0.05, 0.1, gap), (0.5, 0.035, 0.035))
    shot = shoot([wire, ball_before_body()[1]], sphere_lights(48), side=SIDE, across=2.2, noise=0.02)
    maps, report = solved(shot, tmp_path)
    share = report["found"]["unexplained_shadows"]
    assert abs(step_error(maps, shot)) > 0.05 and share > 0.1
    assert any(f"{share:.0%} of the shadows" in sentence for sentence in report["warnings"])


@pytest.mark.long
@pytest.mark.parametrize("lights", [4, 48])
@pytest.mark.parametrize("slope", [0.6, 0.8])
def test_a_ring_is_placed_by_the_light_through_its_hole(slope, lights, tmp_path):
    """A ring far before a body, and the piece of the body in its hole. Light that passes through the hole was taken to be hidden.

    So no shadow told where the ring is, and where normals put it, it seemed to shade the piece, which was moved by the size of the object.
    Tolerance: a pixel of 1/58 of the size, and two σ.
    """
    normal = np.array([0.6 * slope, 0.8 * slope, 1.0]) / np.hypot(slope, 1.0)
    ring = Part((0.1, 0.05, 1.3), (0.45,) * 3, normal=tuple(normal), hole=0.25)
    directions = sphere_lights(lights, least_z=0.5) if lights < 48 else sphere_lights(lights)
    shot = shoot([ring, ball_before_body()[1]], directions, side=SIDE, across=2.2, noise=0.02)
    maps, report = solved(shot, tmp_path)
    assert [part["status"] for part in report["parts"]] == ["reference", "known", "unknown"]
    error = maps.height - shot.z
    front, hole = (abs(np.median(error[maps.part == part]) - np.median(error[maps.part == 1])) for part in (2, 3))
    assert front < min(2.2 / 58, 2 * report["parts"][1]["sigma"])
    assert hole < 0.05  # its step is open, and it stays where it meets the body in the mean


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [11, 12])
def test_steps_of_random_layouts_are_right_within_their_sigma(kind, seed, tmp_path):
    """Two layouts of each kind that nothing was chosen on.

    Tolerance: two σ, and a pixel of the image, 2.4 / 80: shapes of robust normals err by half of one. A step that is open is called so.
    """
    shot = random_layout(kind, seed).shoot(side=80)
    maps, report = solved(shot, tmp_path)
    error = maps.height - shot.z
    for part in range(shot.part.max()):
        mine = np.bincount(maps.part[shot.part == part].astype(int)).argmax()
        placed = report["parts"][mine - 1]
        if placed["status"] == "known":
            step = np.median(error[shot.part == part]) - np.median(error[shot.part == shot.part.max()])
            assert abs(step) < min(2.4 / 80, 2 * placed["sigma"])
        else:
            assert placed["status"] == "unknown" and kind != "ball"


@pytest.mark.long
def test_shadows_part_what_meets_all_along_its_outline(tmp_path):
    """A disc with a hole, 50 pixels before a body: one shift makes it meet the body along three quarters of its two outlines.

    It was joined to the body without a word. Tolerance: two pixels of 1/58 of the size, and two σ.
    """
    shot = random_layout("hole", 40).shoot(side=96, seed=40)
    maps, report = solved(shot, tmp_path)
    disc = report["parts"][int(np.bincount(maps.part[shot.part == 0]).argmax()) - 1]
    assert disc["status"] == "known" and abs(disc["pixels"] - (shot.part == 0).sum()) < 0.05 * disc["pixels"]
    error = maps.height - shot.z
    step = abs(np.median(error[shot.part == 0]) - np.median(error[shot.part == 1]))
    assert step < 0.05 and step < 2 * disc["sigma"]


@pytest.mark.long
@pytest.mark.parametrize(("method", "lights", "noise"), [(Method.ROBUST, 12, 0.01), (Method.ROBUST, 48, 0.03), (Method.SVBRDF, 48, 0.03)])
@pytest.mark.parametrize("walls", [2, 4])
def test_shadows_leave_together_what_meets_at_creases(walls, method, lights, noise, tmp_path):
    """A valley, and a pit of four walls, which throw shadows on each other: each wall is a fragment, and they are one part."""
    turn = 0.3 + 2 * np.pi * np.arange(walls) / walls
    across = np.stack([0.7 * np.cos(turn), 0.7 * np.sin(turn), np.ones(walls)], axis=1) / np.hypot(0.7, 1)
    parts = [Part((0.0, 0.0, 0.0), (1e9,) * 3, normal=tuple(normal)) for normal in across]
    shot = shoot(parts, sphere_lights(lights, least_z=0.1), side=SIDE, across=2.2, inside=1.0, noise=noise)
    maps, report = solved(shot, tmp_path, method)
    assert maps.part is None and report["parts"] == []


def test_an_object_without_a_break_has_no_parts(tmp_path):
    shot = shoot([Part((0.0, 0.0, 0.0), (0.9, 0.8, 0.7))], sphere_lights(24, least_z=0.2), side=SIDE, across=2.2)
    maps, report = solved(shot, tmp_path)
    assert maps.part is None and report["parts"] == [] and report["warnings"] == []


@pytest.mark.long
@pytest.mark.parametrize("slope", [0.05, 0.3])
def test_a_metal_ring_before_paint_is_told_by_its_material(slope, tmp_path):
    """The normals of the ring go on in those of the body, behind it and in its hole: all were one part, or the ring and its hole.

    Tolerance: two pixels of 2.2 / 96, and three σ.
    """
    normal = np.array([0.6 * slope, 0.8 * slope, 1.0]) / np.hypot(slope, 1.0)
    ring = Part((0.1, 0.05, 1.0), (0.45,) * 3, normal=tuple(normal), hole=0.25, albedo=(0.0,) * 3, f0=(0.9, 0.7, 0.4), roughness=0.4)
    body = ball_before_body()[1]._replace(f0=(0.04,) * 3)
    shot = shoot([ring, body], sphere_lights(64, least_z=-0.2), side=96, across=2.2, noise=0.01)
    maps, report = solved(shot, tmp_path, Method.SVBRDF)
    assert [part["status"] for part in report["parts"]] == ["reference", "known", "known"]
    assert np.mean(maps.part[shot.part == 0] == 2) > 0.99
    error = maps.height - shot.z
    for part in (2, 3):
        step = abs(np.median(error[maps.part == part]) - np.median(error[maps.part == 1]))
        assert step < min(2 * 2.2 / 96, 3 * report["parts"][part - 1]["sigma"])


@pytest.mark.long
def test_metal_before_metal_is_placed_by_svbrdf(tmp_path):
    """Bare metal is dark wherever it does not mirror a light: that is no shadow, and a highlight in shadow is none either."""
    parts = [Part((0.1, 0.15, 0.8), (0.3, 0.3, 0.3), albedo=(0.0, 0.0, 0.0), f0=(0.9, 0.7, 0.4), roughness=0.45),
             Part((0.0, 0.0, -0.1), (1.0, 0.9, 0.5), albedo=(0.0, 0.0, 0.0), f0=(0.6, 0.6, 0.6), roughness=0.6)]
    shot = shoot(parts, sphere_lights(64), side=40, across=2.2)
    maps, report = solved(shot, tmp_path, Method.SVBRDF)
    assert report["parts"][1]["status"] == "known"
    assert abs(step_error(maps, shot)) < 0.03  # a pixel of 1/36 of the size
    assert np.median(angles_degrees(maps.normal, shot.scene.normal)[shot.scene.mask]) < 0.5
