"""Colours by CIE against published pairs and identities."""

import numpy as np
import pytest

from service.calibrate.solvers.cielab import WHITES, adaptation, delta_e_2000, lab_from_xyz, xyz_from_lab, xyz_from_linear

SHARMA = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 -1.3802 -84.2814 50 0 -82.7485 1.0000
50 0 0 50 -1 2 2.3669
50 2.4900 -0.0010 50 -2.4900 0.0009 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0011 7.2195
50 -0.0010 2.4900 50 0.0009 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0011 -2.4900 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 56 -27 -3 31.9030
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""
"""Pairs in CIELAB and their difference, to four digits: Sharma, Wu and Dalal 2005, table 1."""


@pytest.mark.parametrize("pair", [line for line in SHARMA.splitlines() if line])
def test_differences_are_those_of_the_published_pairs(pair):
    *pair, wanted = map(float, pair.split())
    first, second = np.array(pair[:3]), np.array(pair[3:])
    assert delta_e_2000(first, second) == pytest.approx(wanted, abs=5.1e-5)
    assert delta_e_2000(second, first) == pytest.approx(wanted, abs=5.1e-5)
    assert delta_e_2000(first, first) == 0


def test_colours_come_back_and_white_stays_white():
    lab = np.random.default_rng(2).uniform([0, -90, -90], [100, 90, 90], (200, 3))
    for white in WHITES.values():
        np.testing.assert_allclose(lab_from_xyz(xyz_from_lab(lab, white), white), lab, atol=1e-9)
        np.testing.assert_allclose(lab_from_xyz(white, white), [100, 0, 0], atol=1e-9)
    np.testing.assert_allclose(adaptation(WHITES["D65"], WHITES["D50"]) @ WHITES["D65"], WHITES["D50"], atol=1e-12)
    for space in ("lin_rec709_scene", "lin_ap1_scene", "lin_p3d65_scene"):  # whose whites differ: D65 and that of ACES
        # OpenColorIO's matrices are float32, and that from ACES adapts between the published digits of both whites
        np.testing.assert_allclose(xyz_from_linear(space) @ np.ones(3), WHITES["D50"], atol=1e-4)
