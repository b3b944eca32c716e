"""Scans with known faults and poses against their designs."""

import csv
import json

import numpy as np
import pytest

from service.comparison.compare import compare
from service.comparison.surfaces import read_scanned
from service.errors import RequestError
from service.requests.register import Alignment, CompareRequest
from service.scans.points.ply_points import read_ply_faces, read_ply_points
from stage.errors import ManifestError, ResultError, ScanError
from tests.scenes.machined_part import SIGMA_M, Part, any_pose, cylinder, machined_part, scan_of, write_mesh, write_scan, write_stl

REGIONS = [{"name": "top", "facing": [0, 0, 1], "tolerance": [-0.08, 0.08]},
           {"name": "boss", "box": [[0, -10, 9], [30, 20, 30]], "tolerance": [-0.08, 0.08]},
           {"name": "below", "facing": [0, 0, -1], "tolerance": [-0.08, 0.08]},
           {"name": "as noisy as tight", "facing": [1, 0, 0], "tolerance": [-0.01, 0.01]}]


def below(points, normals):
    return normals[:, 2] < -0.9


def dent(points, normals, depth=0.15, radius=4.0):
    return np.where((np.hypot(points[:, 0] + 10, points[:, 1] - 15) < radius) & (normals[:, 2] > 0.9), -depth, 0)


def regions(folder, entries=REGIONS):
    path = folder / "tolerances.json"
    path.write_text(json.dumps({"schema": "relit.tolerances/1", "unit": "mm", "regions": entries}))
    return path


def request(folder, scan, design, **given) -> CompareRequest:
    return CompareRequest(scan=scan, design=design, out=folder / "out", device="cpu", **given)


def reported(result) -> dict:
    return json.loads(result.report_path.read_text())


@pytest.mark.long
def test_a_dent_is_found_wherever_the_scan_lies(tmp_path, part):
    made, design = part
    random = np.random.default_rng(3)
    pose = any_pose(random)
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, random, 40_000, pose, below, dent))
    result = compare(request(tmp_path, scan, design, regions=regions(tmp_path)))
    verdicts = {region.name: region for region in result.regions}
    assert {name: str(each.verdict) for name, each in verdicts.items()} == {
        "top": "fail", "boss": "pass", "below": "not inspected", "as noisy as tight": "undecided"}
    # the mean of a patch within the dent: sixteen points of the noise, whose smallest of some hundred is 2.5 σ off
    assert verdicts["top"].least_m == pytest.approx(-1.5e-4, abs=3 * SIGMA_M / 4)
    assert verdicts["below"].seen < 0.2 and min(verdicts[name].seen for name in ("top", "boss")) > 0.99
    placement = reported(result)["placement"]
    motion = np.array(placement["design_from_scan"]) @ pose
    turn = np.array([motion[2, 1] - motion[1, 2], motion[0, 2] - motion[2, 0], motion[1, 0] - motion[0, 1]]) / 2
    pivot, covariance = np.array(placement["pivot_m"]), np.array(placement["covariance"])
    off = np.concatenate([turn, motion[:3, :3] @ pivot + motion[:3, 3] - pivot])
    assert off @ np.linalg.solve(covariance, off) < 27.9  # χ² of six numbers at 1e-4
    assert (placement["other_poses"], placement["open_motions"]) == (0, 0)
    points = read_ply_points(result.deviations_path)
    assert points.colours is not None and len(points.points) == reported(result)["deviations"]["points"]
    assert [row["verdict"] for row in csv.DictReader(result.regions_path.open())] == [region.verdict for region in result.regions]
    assert result.picture_path.stat().st_size > 0 and not result.passed


@pytest.mark.long
@pytest.mark.parametrize("depth", [0.0, 0.12])
def test_verdicts_over_random_scans(tmp_path, part, depth):
    """Of 10 regions within their tolerance none fails, and of 10 with a dent beyond it none passes, at a probability of 5 % for each scan
    of any wrong one."""
    made, design = part
    wrong = 0
    for seed in range(10):
        scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(seed), 20_000, None, below,
                                                         lambda *of: dent(*of, depth=depth, radius=6.0)))
        (top,) = compare(request(tmp_path, scan, design, regions=regions(tmp_path, REGIONS[:1]), align=Alignment.REFINE)).regions
        wrong += top.verdict == ("fail" if depth == 0 else "pass")
    assert wrong <= 2  # binomial: three and more of ten at 5 % are seen in 1 % of such tests


def test_σ_covers_the_deviations(tmp_path, part):
    made, design = part
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(5), 20_000))
    found = compare(request(tmp_path, scan, design, align="none"))
    points = read_ply_points(found.deviations_path)
    assert np.nanmedian(points.sigma) == pytest.approx(SIGMA_M, rel=1e-3)  # float32
    assert found.rms_m == pytest.approx(SIGMA_M, rel=0.03)  # √(1 / 2n) is .005; edges
    estimated = compare(request(tmp_path, write_scan(tmp_path / "bare.ply", scan_of(made, np.random.default_rng(5), 20_000), None), design,
                                align="none"))
    assert reported(estimated)["sigma_source"] == "estimated" and "shared-sigma" in " ".join(estimated.warnings)


@pytest.mark.long
def test_a_datum_carries_the_scan(tmp_path, part):
    """The boss stands .05 mm too high: laid on the plate alone, all of it shows there; laid by all, the plate takes a part of it."""
    made, design = part

    def raised(points, normals):
        return np.where((points[:, 2] > 21) & (normals[:, 2] > 0.9), 0.05, 0)

    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(2), 30_000, None, None, raised))
    given = [{"name": "plate", "facing": [0, 0, -1], "tolerance": [-1, 1], "datum": True},
             {"name": "boss", "box": [[0, -10, 21], [30, 20, 30]], "facing": [0, 0, 1], "tolerance": [-1, 1]}]
    result = compare(request(tmp_path, scan, design, regions=regions(tmp_path, given), align="refine"))
    plate, boss = result.regions
    assert boss.mean_m == pytest.approx(5e-5, abs=4 * SIGMA_M / np.sqrt(500)) and abs(plate.mean_m) < 4 * SIGMA_M / np.sqrt(5000)
    assert reported(result)["placement"]["open_motions"] == 3  # a plane leaves two shifts and a turn open
    assert any("the datum regions leave 3 of 6 motions" in said for said in result.warnings)  # not the surface, as that of a cylinder


@pytest.mark.long
@pytest.mark.parametrize("factor", [1.0, 1.003])
def test_a_scan_that_is_too_large_as_a_whole_is_said(tmp_path, part, factor):
    """A dent of .15 mm does not make the scan smaller, and does not hide that it is larger: the factor is known to .0001."""
    made, design = part
    seen = scan_of(made, np.random.default_rng(4), 20_000, None, below, dent)
    scan = write_scan(tmp_path / "scan.ply", seen._replace(points=factor * seen.points))
    result = compare(request(tmp_path, scan, design, align="refine"))
    placement = reported(result)["placement"]
    if factor == 1:
        assert "size_factor" not in placement and not any("times as large" in words for words in result.warnings)
    else:
        assert placement["size_factor"] == pytest.approx(factor, abs=1e-4)
        assert any("1.0030" in words and "times as large" in words for words in result.warnings)


@pytest.mark.long
@pytest.mark.parametrize(("sides", "radius", "factor"), [(256, 15.0, 1.003), (256, 15.0, 0.998), (256, 15.1, 1.0), (24, 15.0, 1.0)])
def test_what_is_larger_across_and_not_along_is_no_size_of_the_whole(tmp_path, sides, radius, factor):
    """A bar that is too thick and exactly as long, and a design with flats in place of the round, are no error of the scanner."""
    seen = scan_of(cylinder(256, radius), np.random.default_rng(6), 6000)
    scan = write_scan(tmp_path / "scan.ply", seen._replace(points=factor * seen.points))
    placement = reported(compare(request(tmp_path, scan, write_stl(tmp_path / "bar.stl", cylinder(sides)), align="refine")))["placement"]
    assert placement.get("size_factor", 1.0) == pytest.approx(factor, abs=1.5e-4)  # chords of the round, and 6000 points
    assert ("size_factor" in placement) == (factor != 1)


@pytest.mark.long
def test_what_the_surface_leaves_open_is_said(tmp_path):
    random = np.random.default_rng(1)
    for number, made in enumerate((cylinder(), box(40, 24, 6))):
        scan = write_scan(tmp_path / "scan.ply", scan_of(made, random, 10_000, any_pose(random)))
        result = compare(request(tmp_path, scan, write_stl(tmp_path / "design.stl", made), tolerance_m=(-1e-4, 1e-4)))
        placement = reported(result)["placement"]
        assert placement["open_motions"] == (1 if number == 0 else 0) and placement["other_poses"] > 0
        assert any("other poses" in warning for warning in result.warnings)
        assert result.rms_m == pytest.approx(SIGMA_M, rel=0.1) and result.passed  # any of these poses fits


def test_meshes_are_compared_with_their_faces(tmp_path, part):
    made, design = part
    scan = write_stl(tmp_path / "scan.stl", made)
    result = compare(request(tmp_path, scan, design, scan_unit="mm", align="none", sigma_m=1e-5))
    assert result.rms_m < 1e-8  # float32 of a mesh of 80 mm
    assert len(read_ply_faces(result.deviations_path, read_ply_points(result.deviations_path).kept)) == len(made.faces)
    again = compare(request(tmp_path, result.deviations_path, result.deviations_path, design_unit="m", align="none", sigma_m=1e-5))
    assert again.rms_m < 1e-8


@pytest.mark.long
def test_scans_of_something_else_are_refused(tmp_path, part):
    made, design = part
    random = np.random.default_rng(4)
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, random, 5000, any_pose(random)))
    with pytest.raises(ScanError, match="--scan-unit"):
        compare(request(tmp_path, scan, design, scan_unit="mm"))
    other = write_stl(tmp_path / "other.stl", cylinder(radius=20, length=90))
    with pytest.raises(ScanError, match="does not lie on the design"):
        compare(request(tmp_path, scan, other))
    with pytest.raises(RequestError, match="datum"):
        compare(request(tmp_path, scan, design, align="none", regions=regions(tmp_path, [{**REGIONS[0], "datum": True}])))
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_what_stands_on_a_region_keeps_it_from_passing(tmp_path, part):
    """A peg of 3 mm across and 12 mm high, whose points do not belong to the design, is less than a hundredth of the top."""
    made, design = part
    random = np.random.default_rng(6)
    peg = scan_of(cylinder(24, 1.5, 12), random, 1500)
    plain = scan_of(made, random, 40_000, None, below)
    both = plain._replace(points=np.concatenate([plain.points, peg.points + [0.0, 0.016, 0.008]]),
                          normals=np.concatenate([plain.normals, peg.normals]))
    verdicts = []
    for number, scan in enumerate((plain, both)):
        path = write_scan(tmp_path / f"{number}.ply", scan)
        (top,) = compare(request(tmp_path, path, design, align="none", regions=regions(tmp_path, REGIONS[:1]))).regions
        verdicts.append((str(top.verdict), top.strange > 0))
    assert verdicts == [("pass", False), ("undecided", True)]


@pytest.mark.parametrize(("entry", "field"), [({"tolerance": [1, -1]}, "tolerance"), ({"box": [[0, 0, 0], [1, 0, 1]]}, "box"),
                                              ({"facing": [0, 0, 0]}, "facing"), ({"colour": "red"}, "colour")])
def test_wrong_regions_are_named(tmp_path, part, entry, field):
    with pytest.raises(ManifestError, match=rf"regions\[0\].*{field}"):
        compare(request(tmp_path, tmp_path / "none.ply", part[1], regions=regions(tmp_path, [{**REGIONS[0], **entry}])))


@pytest.mark.long
def test_bare_points_have_the_side_from_which_they_were_seen(tmp_path):
    """The rims of a round body turn away from who saw it; points from all around say nothing."""
    made = cylinder()
    design, random = write_stl(tmp_path / "rod.stl", made), np.random.default_rng(8)

    def bare(hidden):
        points = scan_of(made, random, 20_000, None, hidden).points
        path = tmp_path / "bare.ply"
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *(f"property float {name}" for name in "xyz")]
        path.write_bytes("\n".join([*head, "end_header\n"]).encode() + points.astype("<f4").tobytes())
        return path
    seen = compare(request(tmp_path, bare(lambda points, normals: normals[:, 0] < 0.1), design, align="none", sigma_m=SIGMA_M))
    facts = reported(seen)["deviations"]
    assert facts["compared"] > 0.95 * facts["points"] and seen.rms_m == pytest.approx(SIGMA_M, rel=0.05)
    with pytest.raises(ResultError, match="neither faces nor normals"):
        compare(request(tmp_path, bare(None), design))


def box(x, y, z) -> Part:
    """Return a closed box about the origin, from z = 0 upward, mm."""
    corners = np.array([[i, j, k] for i in (-x / 2, x / 2) for j in (-y / 2, y / 2) for k in (0, z)], float)
    return Part(corners, np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                                   [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]))


@pytest.mark.parametrize(("thick", "depth"), [(1, 0.7), pytest.param(3, 2.5, marks=pytest.mark.long)])
def test_the_floor_of_a_pocket_near_the_other_side_of_a_wall_is_not_overlooked(tmp_path, thick, depth):
    made = box(80, 50, thick)
    scan = scan_of(made, np.random.default_rng(7), 40_000, None, None,
                   lambda points, normals: np.where((np.hypot(points[:, 0], points[:, 1]) < 7) & (normals[:, 2] > 0.9), -depth, 0))
    (top,) = compare(request(tmp_path, write_scan(tmp_path / "scan.ply", scan), write_stl(tmp_path / "design.stl", made), align="none",
                             regions=regions(tmp_path, REGIONS[:1]))).regions
    assert top.verdict == "undecided" and top.strange > 0 and top.seen > 0.9


@pytest.mark.long
def test_regions_of_a_part_that_looks_the_same_when_turned_are_not_decided(tmp_path):
    """A cube of which one side is half a millimetre too high in its middle: the pose may lay any side on the one that is judged."""
    made, random = box(40, 40, 40), np.random.default_rng(7)
    scan = scan_of(made, random, 20_000, any_pose(random), None,
                   lambda points, normals: np.where((np.hypot(points[:, 0] - 10, points[:, 1] - 5) < 3) & (normals[:, 2] > 0.9), 0.5, 0))
    result = compare(request(tmp_path, write_scan(tmp_path / "scan.ply", scan), write_stl(tmp_path / "design.stl", made),
                             regions=regions(tmp_path, REGIONS[:1]), tolerance_m=(-1e-4, 1e-4)))
    assert [str(region.verdict) for region in result.regions] == ["undecided", "fail"]  # the whole surface is decided in any pose


@pytest.mark.long
def test_stray_points_decide_nothing(tmp_path, part):
    made, design = part
    random = np.random.default_rng(7)
    scan = scan_of(made, random, 30_000)
    stray = random.choice(len(scan.points), 300, replace=False)
    scan.points[stray] += scan.normals[stray] * random.normal(0, 1e-3, (300, 1))
    scan.points[0] = [5, 0, 0]
    (top,) = compare(request(tmp_path, write_scan(tmp_path / "scan.ply", scan), design, regions=regions(tmp_path, REGIONS[:1]))).regions
    assert top.verdict == "undecided" and max(-top.least_m, top.most_m) > 0.8e-4


@pytest.mark.long
def test_points_beyond_the_border_of_an_open_design_are_not_compared(tmp_path, part):
    made, _ = part
    kept = (made.normals()[:, 2] > 1e-9) & (made.points[made.faces][:, :, 0].max(axis=1) < 20)
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(7), 30_000))
    result = compare(request(tmp_path, scan, write_stl(tmp_path / "open.stl", made._replace(faces=made.faces[kept])), align="none"))
    assert result.rms_m == pytest.approx(SIGMA_M, rel=0.05)


def test_inputs_that_say_no_outside_or_no_σ_are_refused(tmp_path, part):
    made, design = part
    plain = scan_of(made, np.random.default_rng(7), 5000)
    scan = write_scan(tmp_path / "scan.ply", plain)
    for number, faces in enumerate((made.faces[:, ::-1], np.concatenate([made.faces, made.faces[:, ::-1]]))):
        with pytest.raises(ResultError, match="fronts inward"):
            compare(request(tmp_path, scan, write_stl(tmp_path / f"{number}.stl", made._replace(faces=faces)), align="none"))
    with pytest.raises(ScanError, match="no point comes within"):
        compare(request(tmp_path, write_scan(tmp_path / "in.ply", plain._replace(normals=-plain.normals)), design, align="none"))
    with pytest.raises(ResultError, match="sigma that is not a positive"):
        compare(request(tmp_path, write_scan(tmp_path / "negative.ply", plain, -1e-5), design))
    concave = tmp_path / "concave.obj"
    concave.write_text("v 0 0 0\nv 4 0 0\nv 4 4 0\nv 3 4 0\nv 3 1 0\nv 0 1 0\nf 1 2 3 4 5 6\n")
    with pytest.raises(ResultError, match="not convex"):
        compare(request(tmp_path, scan, concave))


@pytest.mark.long
@pytest.mark.parametrize("sigma", [SIGMA_M, None])
def test_points_that_a_file_holds_often_count_by_their_places(tmp_path, part, sigma):
    made, design = part
    plain = scan_of(made, np.random.default_rng(7), 5000)
    found = [compare(request(tmp_path, write_scan(tmp_path / "scan.ply", plain._replace(
        points=np.repeat(plain.points, often, axis=0), normals=np.repeat(plain.normals, often, axis=0)), sigma), design, align="none",
        regions=regions(tmp_path))) for often in (1, 4)]
    assert found[0].sigma_m == found[1].sigma_m and found[0].smallest_fault_m == found[1].smallest_fault_m
    assert found[0].regions == found[1].regions


@pytest.mark.long
def test_a_mesh_whose_triangles_have_corners_of_their_own_is_compared_as_one_that_shares_them(tmp_path):
    fine = machined_part(121, 76)
    design, normals = write_stl(tmp_path / "part.stl", fine), np.zeros_like(fine.points)
    for corner in fine.faces.T:
        np.add.at(normals, corner, fine.normals())
    off = np.random.default_rng(0).normal(0, 1e3 * SIGMA_M, len(normals))
    points = fine.points + normals / np.linalg.norm(normals, axis=1, keepdims=True) * off[:, None]
    apart = points[fine.faces].reshape(-1, 3), np.arange(fine.faces.size).reshape(-1, 3)
    given = regions(tmp_path, [{"name": "below", "facing": [0, 0, -1], "tolerance": [-0.008, 0.008]}])
    found = [compare(request(tmp_path, write_mesh(tmp_path / "scan.ply", Part(*mesh)), design, scan_unit="mm", align="none", regions=given))
             for mesh in ((points, fine.faces), apart)]
    assert found[1].sigma_m == pytest.approx(found[0].sigma_m) and found[0].sigma_m == pytest.approx(SIGMA_M, rel=0.05)
    assert found[1].regions == found[0].regions and str(found[0].regions[0].verdict) == "undecided"


@pytest.mark.long
def test_what_a_datum_leaves_open_keeps_the_σ_of_the_rest(tmp_path, part):
    """The plane below holds no shift along itself: the sides are as sure as the fit of all surfaces is."""
    made, design = part
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(2), 20_000))
    given = [{"name": "plate", "facing": [0, 0, -1], "tolerance": [-1, 1], "datum": True}]
    free, held = (np.array(reported(compare(request(tmp_path, scan, design, align="refine", **more)))["placement"]["covariance"])
                  for more in ({}, {"regions": regions(tmp_path, given)}))
    assert np.diag(held)[3:5] == pytest.approx(np.diag(free)[3:5], rel=0.5)  # about another pivot
    assert held[5, 5] > free[5, 5]


def test_sigma_is_estimated_on_a_map_as_near_the_origin(tmp_path):
    """Floats of 32 bits hold coordinates of 5 000 km to half a metre."""
    across = np.stack(np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)), axis=-1).reshape(-1, 2)
    points = np.column_stack([across, 1e-3 * np.random.default_rng(0).standard_normal(len(across))])
    found = []
    for number, place in enumerate(([0.0, 0, 0], [456789.0, 5432198, 312])):
        path = tmp_path / f"{number}.ply"
        head = "ply\nformat binary_little_endian 1.0\nelement vertex 1600\n" + "".join(f"property double {axis}\n" for axis in (
            "x", "y", "z", "nx", "ny", "nz")) + "end_header\n"
        path.write_bytes(head.encode() + np.hstack([points + place, np.tile([0.0, 0, 1], (1600, 1))]).astype("<f8").tobytes())
        found.append(float(read_scanned(path, 1.0, None).sigma[0]))
    assert found[0] == pytest.approx(1e-3, rel=0.1)  # the scatter of 1600 points around local planes
    assert found[1] == pytest.approx(found[0], rel=0.05)  # nanometres move points on the borders of cells, by which planes are fitted
