"""The choice of pairs of many scans to try: those that see the same side of a surface, and some of each scale."""

import numpy as np

from service.scans.registration import candidates
from service.scans.registration.candidates import Outline, Overlaps, overlapping

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
