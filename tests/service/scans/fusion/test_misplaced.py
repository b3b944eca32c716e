"""Whether a scan lies beside the others, where parts stand in front of each other and where few scans overlap."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.errors import RequestError
from service.requests.register import Misplaced
from service.scans.fusion.misplaced import Readings, Sample, place_scans
from tests.marks import first_short
from tests.scenes.register import fuse_scans
from tests.scenes.statue import place, shoot, turntable, write_scans

VOXEL, SIGMA = 0.025, 0.5e-3
POINTS, AGREEING = 1000, 0.8
"""Points of the scan, and the part of them that some other scan sees too; what it sees at the rest stands in front of them."""


def statue(displacement):
    """A scan of half a sphere, and five others: two from near, which see most of it, and three from afar, from which other parts hide most.

    The scan lies beside its place by a displacement, [3] metres.
    """
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(POINTS, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    one = Sample(0.3 * normals + displacement, normals, np.full(POINTS, SIGMA**2))
    few = Sample(one.points[:10], one.normals[:10], one.variance[:10])  # too few to tell where the others lie
    seen = rng.random(POINTS) < AGREEING
    readings = [Readings(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.float32))]
    for share in (0.6, 0.6, 0.2, 0.2, 0.2):
        same = seen & (rng.random(POINTS) < share)
        apart = np.where(same, SIGMA * rng.normal(size=POINTS), -rng.uniform(0.03, 0.2, POINTS)) + normals @ displacement
        readings.append(Readings(np.arange(POINTS), apart.astype(np.float32), np.full(POINTS, SIGMA, np.float32)))
    return [one, *[few] * 5], readings


def test_a_scan_that_others_hide_is_not_misplaced():
    placing = place_scans(*statue(np.zeros(3)), VOXEL)[0]
    assert placing.compared == POINTS and not placing.misplaced
    assert placing.displacement_m < 2 * SIGMA  # that of the points that agree is a tenth of SIGMA; hidden ones weigh next to nothing


@pytest.mark.parametrize("direction", np.eye(3), ids="xyz")
def test_a_scan_that_lies_beside_its_place_is(direction):
    """The hidden points, which are most of what the scans from afar see, do not tell by how much."""
    assert place_scans(*statue(1.6 * VOXEL * direction), VOXEL)[0].misplaced


def balls(displacements, overlapping):
    """Scans of one half of a sphere that lie beside their places by displacements, [N, 3] metres; pairs that overlap see all in common."""
    one = statue(np.zeros(3))[0][0]
    random, count = np.random.default_rng(1), len(displacements)
    samples = [one._replace(points=one.points + displacement) for displacement in displacements]
    readings = []
    for number in range(count):
        seen = [other for other in range(count) if {number, other} in overlapping]
        at = np.concatenate([np.arange(POINTS) + POINTS * other for other in seen])
        apart = np.concatenate([one.normals @ (displacements[other] - displacements[number]) for other in seen])
        noisy = apart + SIGMA * random.normal(size=len(apart))
        readings.append(Readings(at, noisy.astype(np.float32), np.full(len(at), SIGMA, np.float32)))
    return samples, readings


MOVED, THERE = np.array([2 * VOXEL, 0.0, 0.0]), np.zeros(3)


@pytest.mark.parametrize("size", [1.6, 2.0, 10.0])
def test_the_middle_of_a_chain_is_not_told_from_its_ends(size):
    """The ends see the middle alone, so that either it is misplaced or both of them."""
    placings = place_scans(*balls([THERE, size * VOXEL * np.eye(3)[0], THERE], [{0, 1}, {1, 2}]), VOXEL)
    assert all(placing.misplaced and placing.against for placing in placings)
    assert all(placing.displacement_m > VOXEL / 2 for placing in placings)  # of when it was taken out, not of nothing that is left


def test_two_scans_name_each_other():
    assert [placing.against for placing in place_scans(*balls([THERE, MOVED], [{0, 1}]), VOXEL)] == [(1,), (0,)]


@pytest.mark.parametrize(("wrong", "overlapping"), [
    (2, [{0, 1}, {1, 2}]), (1, [{0, 1}, {1, 2}, {0, 2}]), (0, [{0, 1}, {1, 2}, {2, 3}])])
def test_a_scan_is_accused_where_a_third_one_confirms_the_other(wrong, overlapping):
    placings = place_scans(*balls([MOVED if number == wrong else THERE for number in range(1 + max(map(max, overlapping)))], overlapping),
                           VOXEL)
    assert [placing.misplaced for placing in placings] == [number == wrong for number in range(len(placings))]
    assert not placings[wrong].against and placings[wrong].displacement_m > VOXEL / 2


def test_two_pairs_that_contradict_each_other_are_not_told_apart():
    placings = place_scans(*balls([THERE, THERE, 3 * MOVED, 3 * MOVED], [{0, 1}, {1, 2}, {2, 3}]), VOXEL)
    assert [placing.against for placing in placings] == [(), (2,), (1,), ()]


@pytest.mark.long
def test_scans_of_another_scale_than_their_poses_are_named_so(tmp_path):
    """Every scan grows about its own scanner, and seems misplaced."""
    shots = [shot._replace(depth=1.01 * shot.depth) for shot in turntable(6, (192, 144), range_m=2.0)]
    # the factor by which depths were multiplied: at the fourth digit the fit is off, as it moves no point to another pixel
    with pytest.raises(RequestError, match=r"all fit if their coordinates are multiplied by 0\.990\d, .* by 1\.0\d+: the unit"):
        fuse_scans(write_scans(tmp_path, shots), tmp_path / "out")


@pytest.mark.long
@pytest.mark.parametrize(("count", "left_out"), [(12, True), (9, False)])
def test_a_scan_that_is_turned_by_90_degrees_is_told_by_what_others_saw_through(tmp_path, count, left_out):
    """Its surface lies near that of others only where it agrees with them by chance: it was fused with them, without a word. Where one
    other alone saw through it, nothing tells which of the two is wrong."""
    shots = turntable(count, (96, 72), range_m=2.0)
    poses, turn = [shot.world_from_camera for shot in shots], np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turned = 3 if left_out else 2
    found = fuse_scans(write_scans(tmp_path, shots, poses=[turn @ pose if number == turned else pose for number, pose in enumerate(poses)]),
                       tmp_path / "out")
    assert [scan["fused"] for scan in found.facts["scans"]] == [number != turned or not left_out for number in range(count)]
    words = "several other scans saw through" if left_out else "one of their poses is wrong, or what they see has moved"
    assert f"view {turned}" in found.warnings[0] and words in found.warnings[0]


@pytest.mark.long
@pytest.mark.parametrize(("order", "words"), [
    ([1, 0, *range(2, 12)], "the poses of view 0 and view 1 are exchanged"),  # one of them was fused, 77 mm off
    ([*range(1, 12), 0], "each pose is that of the scan after"),
    ([*range(11, -1, -1)], "the poses are in the opposite order"),
    (sorted(range(12), key=str), "the poses are in the order of their numbers as text"),
    ([2, 7, 10, 0, 5, 3, 9, 1, 6, 11, 4, 8], "the poses contradict each other: run relit register first")])
def test_poses_in_another_order_are_named(tmp_path, order, words):
    shots = turntable(12, (96, 72), range_m=2.0)
    with pytest.raises(RequestError, match=words):
        fuse_scans(write_scans(tmp_path, shots, poses=[shots[number].world_from_camera for number in order]), tmp_path / "out")


def arc(folder, poses=None):
    """Three scans of the statue, 20 degrees apart, in the world frame of the first."""
    shots = [shoot(place(np.radians(angle), 0.1, 2.0), (80, 60), 130.0, seed=angle) for angle in (0, 20, 40)]
    first = np.linalg.inv(shots[0].world_from_camera)
    return write_scans(folder, shots, poses=[poses(first @ shot.world_from_camera) for shot in shots])


@pytest.mark.long
@pytest.mark.parametrize("moved_m", [0.0, 1.0])
def test_inverted_poses_are_named_so(tmp_path, moved_m):
    """About a round body most of the surface fits all the same; with the world beside it nothing does."""
    file = arc(tmp_path, lambda pose: np.linalg.inv(pose + moved_m * np.outer(np.eye(4)[0], np.eye(4)[3])))
    with pytest.raises(RequestError, match=r"scans\[\]\.scan_to_world: the poses are world_to_scan: .* write them as scan_to_world"):
        fuse_scans(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    kept = fuse_scans(file, tmp_path / "out", misplaced=Misplaced.KEEP)
    assert sum("the poses are world_to_scan" in warning for warning in kept.warnings) == 1


@first_short(("written", "words"), [
    (np.linalg.inv, "that were imported are world_to_camera"),
    (lambda pose: with_quaternion(pose, np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)), "begin with w"),
    (lambda pose: pose @ np.diag([1.0, -1, -1, 1]), "the y and z axes of the scans are negated")])
def test_poses_of_imported_frames_that_mean_something_else_are_named(tmp_path, written, words):
    """Files of depth cameras have poses in the axes of OpenCV, y down and z forwards."""
    axes = np.diag([1.0, -1, -1, 1])
    with pytest.raises(RequestError, match=words):
        fuse_scans(arc(tmp_path, lambda pose: written(pose @ axes) @ axes), tmp_path / "out")


def with_quaternion(pose, quaternion):
    """A pose with another rotation, x y z w."""
    other = pose.copy()
    other[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return other


def test_right_poses_are_not_inverted_ones(tmp_path):
    found = fuse_scans(arc(tmp_path, lambda pose: pose), tmp_path / "out")
    assert all(scan["fused"] for scan in found.facts["scans"]) and not any("world_to_scan" in warning for warning in found.warnings)
