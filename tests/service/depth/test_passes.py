"""A scanner that drives through a room twice: what is declared wrongly shows where it sees the same again."""

import json
import re

import numpy as np
import pytest

from service.depth.scan import scan
from service.requests.depth import ScanRequest
from stage.errors import ImageError
from tests.marks import first_short
from tests.scenes.scanned_room import write_scan


def scanned(folder):
    result = scan(ScanRequest(scan=folder, out=folder / "out", device="cpu"))
    return result.warnings, json.loads(result.report_path.read_text())["found"].get("passes")


@first_short("right", [{}, {"noise": 0.05}, {"count": 8000}, {"noise": 0.0}])
def test_passes_of_a_right_scan_lie_within_its_noise(tmp_path, right):
    warnings, passes = scanned(write_scan(tmp_path, **right))
    assert warnings == () and (passes is None or passes["apart_m"] < 2 * max(passes["within_m"], 1e-3))
    if not right:
        assert 0.003 < passes["within_m"] < 0.01  # ranges scatter by 1 cm, along rays that meet the walls aslant


@pytest.mark.long
@pytest.mark.parametrize(("wrong", "words"), [
    ({"inverted": True}, "the poses are platform_from_world"),
    ({"factors": (1, -1, 1, 1, 1)}, "azimuth_rad has the other sign"),
    ({"factors": (1, 1, -1, 1, 1)}, "elevation_rad has the other sign"),
    ({"factors": (1, 1, 1, 1000, 1)}, "range_m is in millimetres"),
], ids=["poses", "azimuth", "elevation", "millimetres"])
def test_another_sign_unit_or_sense_is_named(tmp_path, wrong, words):
    (warning,), passes = scanned(write_scan(tmp_path, **wrong))
    assert words in warning and passes["apart_m"] > 2 * passes["within_m"]


@pytest.mark.long
@pytest.mark.parametrize(("wrong", "pattern", "size"), [
    ({"late_s": -0.2}, r"if ([0-9.]+) s are taken off time_s", 0.2),
    ({"late_s": 0.1}, r"if ([0-9.]+) s are added to time_s", 0.1),
    ({"turned": 2.0}, r"platform_from_scanner is turned by ([0-9.]+)°", 2.0),
], ids=["clock early", "clock late", "mounting"])
def test_a_clock_or_a_mounting_that_is_off_is_measured(tmp_path, wrong, pattern, size):
    """To a twentieth: by some thousand places with a noise of 1 cm, which the fault moves by several."""
    (warning,), _ = scanned(write_scan(tmp_path, **wrong))
    found = re.search(pattern, warning)
    assert found is not None, warning
    assert float(found[1]) == pytest.approx(size, rel=0.05)


def test_a_platform_that_stands_still_has_no_passes(tmp_path):
    assert scanned(write_scan(tmp_path, still=True)) == ((), None)


@pytest.mark.parametrize("column", ["azimuth_rad", "elevation_rad"])
def test_angles_in_degrees_are_refused(tmp_path, column):
    factors = np.where(np.array(["time_s", "azimuth_rad", "elevation_rad", "range_m", "intensity"]) == column, 180 / np.pi, 1.0)
    with pytest.raises(ImageError, match=f"{column} reaches .*: give angles in radians"):
        scan(ScanRequest(scan=write_scan(tmp_path, count=2000, factors=tuple(factors)), out=tmp_path / "out", device="cpu"))
