"""Scans that look much the same when they are turned are named, whether the pose that was found is right or not."""

import numpy as np
import pytest

from service.scans.registration.diagnosis import looks_alike_turned
from service.scans.registration.extent import CELLS_ACROSS, extent_of
from service.scans.registration.pairs import prepare
from service.scans.registration.registration import RegistrationOptions, register
from tests.scenes.turntable import figure, pillar, urn, vase
from tests.service.scans.registration.test_registration import jug, off, registered, scan_of, seen


@pytest.mark.long
@pytest.mark.parametrize(("body", "alike"), [(figure, False), (vase, True), (jug, True), (urn, True), (pillar, True)])
def test_a_body_is_known_by_what_it_looks_like_turned(body, alike):
    for view in seen(body, 0, 45, rows=80):
        scan = scan_of(view)
        cell = extent_of(scan) / CELLS_ACROSS
        assert looks_alike_turned(prepare(scan, cell_m=cell), cell) is alike


def test_a_body_joined_to_its_turned_self_is_named():
    """From scans 90° apart nothing tells that the arm is missing: the pose is a quarter turn off, with a small σ."""
    views = seen(urn, 0, 90, rows=100)
    found = registered(views)
    assert np.degrees(np.linalg.norm(off(views, found)[1][:3])) > 80
    assert found.alike_turned == (0, 1)


def test_what_a_start_places_is_not_named():
    views = seen(urn, 0, 20, rows=80)
    scans = [scan_of(view) for view in views]
    starts = [view.world_from_scan for view in views]
    assert register(scans, starts, RegistrationOptions()).alike_turned == ()
