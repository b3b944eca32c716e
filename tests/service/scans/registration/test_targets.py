"""Registration by named targets: what shape alone does not determine, honest covariances, and targets that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.scans.points.rigid import applied, inverse, step_between
from service.scans.points.scan import Scan, Target
from service.scans.registration.pairs import Evidence, PairState
from service.scans.registration.registration import Registration
from service.scans.registration.target_pairs import TargetPose, pose_by_targets
from tests.scenes.register import off, register, scan_of, seen
from tests.scenes.turntable import MM, View, figure, pose, see, vase

SIGMA = 0.1 * MM
PLACES = {f"T{k}": np.array([0.45 * np.cos(angle), height, 0.45 * np.sin(angle)])
          for k, (angle, height) in enumerate([(0, -0.4), (1, 0.3), (2, -0.45), (3.3, 0.2), (4.4, -0.3), (5.5, 0.4)])}
"""Targets on stands around the object, which turn with it."""


def targets_of(world_from_scan: np.ndarray, seed: int, places: dict[str, np.ndarray], sigma: float = SIGMA) -> tuple[Target, ...]:
    rng = np.random.default_rng(seed)
    return tuple(Target(name, applied(inverse(world_from_scan), place[None])[0] + sigma * rng.standard_normal(3), sigma**2 * np.eye(3))
                 for name, place in places.items())


def with_targets(view: View, seed: int, **changed: np.ndarray | None) -> Scan:
    places = {name: place for name, place in {**PLACES, **changed}.items() if place is not None}
    return replace(scan_of(view), targets=targets_of(view.world_from_scan, seed, places))


def registered(scans: list[Scan]) -> Registration:
    return register(scans, [None] * len(scans))


def vases(**changed_in_the_third) -> tuple[list[View], list[Scan]]:
    views = seen(vase, 0, 60, 130, rows=80)
    return views, [with_targets(view, k, **(changed_in_the_third if k == 2 else {})) for k, view in enumerate(views)]


def true_within(views: list[View], found: Registration) -> None:
    """Six targets of .1 mm half a metre away leave .1 mm and .02° of a pair; five standard deviations of it."""
    for number, step in enumerate(off(views, found)):
        assert np.linalg.norm(step[3:]) < 0.5 * MM and np.degrees(np.linalg.norm(step[:3])) < 0.1
        covariance = found.covariances[number]
        if number == found.reference:
            continue
        truth = found.poses[0] @ inverse(views[0].world_from_scan) @ views[number].world_from_scan
        own = step_between(found.poses[number] @ inverse(truth), found.poses[number][:3, 3])
        assert own @ np.linalg.solve(covariance, own) < 30  # of χ² with six degrees of freedom, one in 25 000 is larger
        assert np.sqrt(np.trace(covariance[:3, :3])) < np.radians(0.1)


def test_a_target_that_moved_is_named_and_moves_no_pose():
    views, scans = vases(T3=PLACES["T3"] + [0, 0.004, 0])
    found = registered(scans)
    true_within(views, found)
    wrong = {place.name: place.wrong for place in found.targets if place.wrong}
    assert list(wrong) == ["T3"] and wrong["T3"] == {2: pytest.approx(0.004, abs=1e-3)}


@pytest.mark.long
def test_targets_with_the_names_of_others_are_told():
    views, scans = vases(T1=PLACES["T5"], T5=PLACES["T1"])
    found = registered(scans)
    true_within(views, found)
    assert {place.name: place.same_as for place in found.targets if place.same_as} == {"T1": {2: "T5"}, "T5": {2: "T1"}}


def test_too_few_targets_are_said():
    _, scans = vases(T0=None, T1=None, T2=None, T3=None)
    found = registered(scans)
    assert set(found.poses) == {0, 1}
    assert found.alone[2].partition(": 3 ")[0].endswith("only 2 targets in common (T4, T5)")
    assert "looks the same" in found.alone[2]


@pytest.mark.long
def test_targets_on_the_table_do_not_move_an_object_that_was_pushed():
    """The surfaces of a figure determine its pose: targets that all moved against it are refused, and told."""
    views = [see(figure, pose(angle), rows=80, sigma=0.25 * MM, seed=k) for k, angle in enumerate((0.0, 30.0))]
    pushed = {name: place + [0.01, 0, 0] for name, place in PLACES.items()}
    scans = [with_targets(views[0], 0), with_targets(views[1], 1, **pushed)]
    found = registered(scans)
    by = {pair.by: pair for pair in found.pairs}
    assert by[Evidence.SURFACES].state is PairState.JOINED and by[Evidence.TARGETS].state is PairState.CONTRADICTED
    assert "moved together against the object" in by[Evidence.TARGETS].reason
    assert np.linalg.norm(off(views, found)[1][3:]) < 1 * MM
    agreeing = registered([scans[0], with_targets(views[1], 1)])
    assert [pair.by for pair, _ in agreeing.kept] == [Evidence.SURFACES, Evidence.TARGETS]
    assert np.linalg.norm(off(views, agreeing)[1][3:]) < 0.2 * MM


def pair_of(places_b: dict[str, np.ndarray], seed: int = 0, names: tuple[str, ...] = tuple(PLACES)) -> tuple[TargetPose, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.from_rotvec(rng.standard_normal(3)).as_matrix(), rng.standard_normal(3)
    a = targets_of(np.eye(4), 2 * seed, {name: PLACES[name] for name in names})
    return pose_by_targets(a, targets_of(truth, 2 * seed + 1, places_b), first_row=(0, 0)), truth


@pytest.mark.long
def test_the_pose_of_a_pair_is_as_wrong_as_it_says():
    """χ² with six degrees of freedom has a mean of 6, of 200 draws ± .25."""
    squares = []
    for seed in range(200):
        found, truth = pair_of(PLACES, seed)
        assert found.fit is not None and found.used == tuple(PLACES)
        step = step_between(found.fit.pose @ inverse(truth), found.fit.pivot)
        squares.append(step @ found.fit.normal @ step)
        assert abs(found.fit.scale) < 6 * found.fit.scale_sigma
    assert 5 < np.mean(squares) < 7


@pytest.mark.parametrize(("change", "words"), [
    ({"T0": PLACES["T0"] + [0.01, 0, 0], "T1": PLACES["T1"] + [0, 0.02, 0], "T2": PLACES["T2"] + [0, 0, 0.03]},
     "their 6 common targets do not keep their distances, which"),
    ({name: 1e3 * place for name, place in PLACES.items()}, "they keep them if the second scan is 0.001 times as large"),
    ({name: place * [1, 1, -1] for name, place in PLACES.items()}, "fit each other mirrored alone"),
])
def test_targets_that_fit_no_motion_are_refused(change, words):
    found, _ = pair_of({**PLACES, **change})
    assert found.fit is None and words in found.reason


def test_targets_in_a_line_are_refused():
    line = {f"T{k}": np.array([0.2 * k, 0.1 * k, 0.0]) for k in range(5)}
    a, b = (targets_of(np.eye(4), seed, line) for seed in (1, 2))
    found = pose_by_targets(a, b, first_row=(0, 0))
    assert found.fit is None and found.reason.endswith("lie in a line: the turn about it is not determined")


def test_one_wrong_target_of_four_is_found_and_one_of_three_leaves_none():
    moved = {**PLACES, "T2": PLACES["T2"] + [0.0, 0.003, 0.003]}
    four, _ = pair_of(moved, names=("T0", "T1", "T2", "T4"))
    assert four.used == ("T0", "T1", "T4") and four.fit is not None
    three, _ = pair_of(moved, names=("T0", "T1", "T2"))
    assert three.fit is None and three.state is PairState.MISFIT


def test_scans_need_no_common_surface():
    views = seen(figure, 0, 180, rows=80)
    found = registered([with_targets(view, k) for k, view in enumerate(views)])
    true_within(views, found)
    assert [pair.by for pair, _ in found.kept] == [Evidence.TARGETS]
