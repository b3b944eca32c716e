"""Registration of more scans than can all be compared with each other, and of scans of several scales."""

from dataclasses import replace

import numpy as np
import pytest

from service.scans.points import cloud
from service.scans.points.rigid import inverse, moved, step_between
from service.scans.registration import candidates, free_space, registration
from service.scans.registration.candidates import Outline, Overlaps, overlapping
from service.scans.registration.registration import Registration
from tests.scenes.register import off, register, scan_of, seen
from tests.scenes.turntable import MM, View, figure

FEW = 3
"""Scans up to which all pairs are tried here."""
MIDDLE = np.array([0.14, 0.1, 0.08])
"""The middle of an arm of the figure, metres."""


def bounded(monkeypatch, partners: int) -> None:
    for module in (candidates, registration):
        monkeypatch.setattr(module, "ALL_PAIRS", FEW)
        monkeypatch.setattr(module, "PARTNERS", partners)
    monkeypatch.setattr(candidates, "ALIKE_AT_ONCE", 2)


def rough(views: list[View]) -> list[np.ndarray | None]:
    rng = np.random.default_rng(3)
    return [moved(rng.normal(scale=[0.004] * 3 + [0.003] * 3), np.zeros(3), view.world_from_scan) for view in views]


def worst(views: list[View], found: Registration) -> tuple[float, float]:
    wrong = off(views, found)
    return float(np.linalg.norm(wrong[:, 3:], axis=1).max()), float(np.degrees(np.linalg.norm(wrong[:, :3], axis=1)).max())


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False], ids=["from starts", "searched"])
def test_a_part_of_all_pairs_is_enough(known, monkeypatch):
    """Pixels of 10 mm; the bend between them leaves more than the noise of 0.25 mm."""
    bounded(monkeypatch, 3)
    views = seen(figure, *range(0, 360, 40))
    found = register([scan_of(view) for view in views], rough(views) if known else None)
    assert len(found.poses) == len(views) and len(found.pairs) < len(views) * (len(views) - 1) // 2
    shift, turn = worst(views, found)
    assert shift < 0.2 * MM and turn < 0.05


def test_scans_are_thinned_to_a_bound(monkeypatch):
    """1500 of 5000 points are kept, and 1000 squares of a range image of 10 800 pixels."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 1500)
    monkeypatch.setattr(free_space, "MOST_PIXELS", 1000)
    views = seen(figure, 0, 40)
    found = register([scan_of(view) for view in views], rough(views))
    shift, turn = worst(views, found)
    assert shift < 1 * MM and turn < 0.2


@pytest.mark.long
def test_a_part_seen_from_near_is_joined_to_the_whole_where_it_has_a_start():
    """An arm alone, with pixels of 3 mm beside pixels of 8 mm."""
    views = seen(figure, 0, 30, 60, rows=160)
    close = seen(figure, 20, rows=400)[0]
    scan = scan_of(close, points_only=True)
    world = scan.points @ close.world_from_scan[:3, :3].T + close.world_from_scan[:3, 3]
    there = np.linalg.norm(world - MIDDLE, axis=1) < 0.14
    part = replace(scan, points=scan.points[there], sigma=scan.sigma[there], name="arm")
    scans = [*(scan_of(view) for view in views), part]
    every = [*views, close]
    found = register(scans, rough(every))
    assert set(found.poses) == {0, 1, 2, 3}
    step = step_between(inverse(found.poses[0] @ inverse(views[0].world_from_scan)) @ found.poses[3] @ inverse(close.world_from_scan),
                        MIDDLE)
    assert np.linalg.norm(step[3:]) < 1 * MM


NONE = np.zeros((0, 33), dtype=np.float32)
ANY = 40
"""More scans than are all tried."""


def sheet(towards: float, cell_m: float = 0.1, side: float = 2.0) -> Outline:
    """A square sheet at z = 0 that faces along z."""
    x, y = np.meshgrid(np.arange(0, side, cell_m), np.arange(0, side, cell_m))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    return Outline(points, np.broadcast_to(np.array([0, 0, towards], np.float32), points.shape), NONE, cell_m)


def overlaps_of(outlines: list[Outline]) -> Overlaps:
    return Overlaps(dict(enumerate(outlines)), {number: np.eye(4) for number in range(len(outlines))}, 2.0)


def test_scans_of_both_sides_of_a_sheet_have_no_surface_in_common():
    overlaps = overlaps_of([sheet(1), sheet(-1), sheet(1)])
    assert overlaps.most(0, 1) == overlaps.most(0, 2) == 1
    assert overlaps.facing(0, 1) == 0 and overlaps.facing(0, 2) == 1
    assert overlapping(range(3), overlaps, 0.1, count=ANY, wanted=lambda a, b: True) == [(0, 2)]


def test_a_turned_sheet_is_told_by_its_pose():
    outlines = {0: sheet(1), 1: sheet(1)}
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    over[1, 3] = 2.0
    assert Overlaps(outlines, {0: np.eye(4), 1: over}, 2.0).facing(0, 1) == 0


def test_scans_of_each_scale_have_partners_of_both(monkeypatch):
    monkeypatch.setattr(candidates, "PARTNERS", 2)
    monkeypatch.setattr(candidates, "OTHER_PARTNERS", 1)
    outlines = [sheet(1) for _ in range(6)] + [sheet(1, 0.02, 0.4) for _ in range(6)]
    kept = overlapping(range(12), overlaps_of(outlines), 0.1, count=ANY, wanted=lambda a, b: True)
    near = set(range(6, 12))
    for number in range(12):
        others = [b if a == number else a for a, b in kept if number in (a, b)]
        alike = [other for other in others if (other in near) == (number in near)]
        assert len(alike) >= 2 and len(others) - len(alike) >= 1
    assert len(kept) < 40  # of 66
