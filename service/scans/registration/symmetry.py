"""Test whether a scan looks much the same when it is turned about an axis, so that little of it tells one of its poses from another."""

import numpy as np

from service.scans.points.rigid import screwed
from service.scans.registration.coarse import is_near
from service.scans.registration.fine import fit
from service.scans.registration.pair_tasks import overlap_of
from service.scans.registration.pairs import Prepared, fits_roughly, step_units

TURNS_DEG = (-90.0, -60.0, 60.0, 90.0)
"""Turns from which a scan is fitted to itself. A body that its parts tell apart comes back to where it was, or fits badly."""
LEAST_ALIKE = 0.25
"""The least part of a scan that lies on itself after such a turn: half of what is seen leaves the sight of the camera. Of a vase it is .43
and more, of the statue of tests/scenes .28 to .48."""


def looks_alike_turned(scan: Prepared, cell_m: float) -> bool:
    """Return whether a good part of a scan lies on itself after a turn about the axis about which its pose is determined least.

    Args:
        cell_m: side of the cells of its rough scale, metres.
    """
    here = fit(scan.rough, scan.rough, np.eye(4), [2 * cell_m])
    if here is None:
        return False
    units = step_units(scan)
    _, axes = np.linalg.eigh(here.normal * np.outer(units, units))
    twist = units * next(axis for axis in axes.T if np.linalg.norm(axis[:3]) > 0.5)
    for turn in np.radians(TURNS_DEG):
        start = screwed(turn * twist / np.linalg.norm(twist[:3]), here.pivot, np.eye(4))
        found = fit(scan.rough, scan.rough, start, [4 * cell_m, 2 * cell_m])
        if found is None or is_near(found.pose, np.eye(4), scan.rough.middle, cell_m) or not fits_roughly(found, scan, scan, cell_m):
            continue
        if overlap_of(scan, scan, found.pose, cell_m) >= LEAST_ALIKE:
            return True
    return False
