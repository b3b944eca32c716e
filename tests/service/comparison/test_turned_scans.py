"""Scans and designs that are mirrored or turned inside out, and limits in another unit, are refused."""

import json
import re

import numpy as np
import pytest

from service.comparison.compare import compare
from service.errors import RequestError
from service.requests.register import Alignment, CompareRequest
from stage.errors import ScanError
from tests.scenes.machined_part import SIGMA_M, Part, Scanned, any_pose, scan_of, write_scan, write_stl


def request(folder, scan, design, **given) -> CompareRequest:
    return CompareRequest(scan=scan, design=design, out=folder / "out", device="cpu", **given)


SLIGHT = 0.6
"""Height of the bump of a panel, mm."""


def panel() -> Part:
    """An open surface of 120 x 80 mm with one slight bump aside of its middle."""
    x, y = np.meshgrid(np.linspace(-60, 60, 61), np.linspace(-40, 40, 41), indexing="ij")
    z = SLIGHT * np.exp(-(((x - 20) / 25) ** 2) - ((y + 5) / 15) ** 2)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return Part(np.stack([x, y, z], axis=-1).reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


@pytest.mark.long
@pytest.mark.parametrize(("axes", "sides", "words"), [(1, -1, "its outside is taken for the inside"), (-1, 1, "only as its mirror image ("),
                                                      (-1, -1, "mirror image turned inside out")])
def test_a_scan_that_is_turned_is_refused(tmp_path, part, axes, sides, words):
    made, design = part
    points, normals = scan_of(made, np.random.default_rng(5), 20_000, any_pose(np.random.default_rng(6)))
    mirror = np.array([1, axes, 1])
    scan = write_scan(tmp_path / "scan.ply", Scanned(points * mirror, sides * normals * mirror))
    with pytest.raises(ScanError, match=re.escape(words)):
        compare(request(tmp_path, scan, design))


@pytest.mark.long
def test_an_open_design_whose_fronts_are_turned_is_refused(tmp_path):
    """The panel lies on it upside down, within the reach: deviations would be up to the bump's height off."""
    made = panel()
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(7), 10_000, any_pose(np.random.default_rng(8))))
    right = compare(request(tmp_path, scan, write_stl(tmp_path / "right.stl", made)))
    assert right.rms_m < 2 * SIGMA_M and not any("opposite" in sentence for sentence in right.warnings)
    with pytest.raises(ScanError, match="open surface"):
        compare(request(tmp_path, scan, write_stl(tmp_path / "turned.stl", made._replace(faces=made.faces[:, ::-1]))))


@pytest.mark.long
def test_faces_that_turn_opposite_ways_are_said(tmp_path, part):
    made, _ = part
    faces = made.faces.copy()
    faces[1000:1200] = faces[1000:1200, ::-1]
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(9)))
    result = compare(request(tmp_path, scan, write_stl(tmp_path / "part.stl", made._replace(faces=faces)), align=Alignment.REFINE))
    assert any("turn their fronts opposite ways" in sentence for sentence in result.warnings)


@pytest.mark.parametrize(("given", "words"), [
    ({"tolerance_m": (-0.1, 0.1)}, "--tolerance-m: allows -100 to +100 mm, but deviations are looked for up to"),
    ({"smallest_fault_m": 4.0}, "--smallest-fault-m 4: is larger than the design"),
])
def test_options_in_millimetres_are_refused(tmp_path, part, given, words):
    made, design = part
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(9), 1000))
    with pytest.raises(RequestError, match=re.escape(words)):
        compare(request(tmp_path, scan, design, **given))


def test_regions_whose_limits_nothing_exceeds_are_refused(tmp_path, part):
    made, design = part
    scan = write_scan(tmp_path / "scan.ply", scan_of(made, np.random.default_rng(9), 1000))
    entries = [{"name": "top", "facing": [0, 0, 1], "tolerance": [-0.08, 80]},
               {"name": "low", "facing": [0, 0, -1], "tolerance": [-80, 80]}]
    path = tmp_path / "tolerances.json"
    path.write_text(json.dumps({"schema": "relit.tolerances/1", "unit": "mm", "regions": entries}))
    with pytest.raises(RequestError, match="region low: allows -80 to"):
        compare(request(tmp_path, scan, design, regions=path))
