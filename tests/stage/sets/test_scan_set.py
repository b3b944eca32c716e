"""scan-set.json: all faults at once, in sentences that name file and field, and what is written is read again."""

import json
from pathlib import Path

import numpy as np
import pytest

from stage.errors import ManifestError
from stage.sets.scan_set import ScanSet, read_scan_set, write_scan_set

TURN = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=float)


def record(*scans: dict, **further) -> dict:
    return {"schema": "relit.scan-set/1", "name": "statue", "scans": list(scans), **further}


def scan(name: str = "front", **further) -> dict:
    return {"name": name, "path": f"{name}.ply", **further}


def read(folder: Path, data: dict) -> ScanSet:
    (folder / "scan-set.json").write_text(json.dumps(data))
    return read_scan_set(folder)[1]


def test_what_is_written_is_read_again(tmp_path):
    covariance = (np.diag([1e-8] * 3 + [1e-10] * 3) + 1e-12).tolist()
    data = record(scan(scan_to_world=TURN.tolist(), pose_covariance=covariance, unit="mm"), scan("back", sigma_m=2e-4),
                  turntable={"axis_point_m": [0, 0, -1], "axis": [0, 2, 0], "angles_deg": [0, 20]})
    first = read(tmp_path, data)
    write_scan_set(first, tmp_path / "again" / "scan-set.json")
    assert read_scan_set(tmp_path / "again" / "scan-set.json")[1] == first
    assert first.turntable is not None and first.turntable.axis == (0, 1, 0)


def test_every_fault_is_named(tmp_path):
    mirrored, scaled, twisted = np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]), np.diag([1e-8] * 5 + [-1.0])
    data = record(scan(scan_to_world=mirrored.tolist()), scan("b", scan_to_world=scaled.tolist()), scan("front"), scan("c", unit="feet"),
                  scan("d", pose_covariance=twisted.tolist(), scan_to_world=TURN.tolist()),
                  scan("e", pose_covariance=np.eye(6).tolist()), scan("f", sigma_m=0),
                  turntable={"axis_point_m": [0, 0, 0], "axis": [0, 0, 1], "angles_deg": [0.0]})
    with pytest.raises(ManifestError) as caught:
        read(tmp_path, data)
    faults = str(caught.value)
    for expected in ("scans[0].scan_to_world: mirrors",
                     "scans[1].scan_to_world: is not a rotation and a translation",
                     "scans[2].name: front is already the name of scans[0]", "scans[3].unit", "scans[4].pose_covariance: has a variance",
                     "scans[5]: pose_covariance: is given without scan_to_world", "scans[6].sigma_m",
                     "turntable.angles_deg: has 1 entries for 7 scans"):
        assert expected in faults, expected
    assert faults.count("scan-set.json: ") == 8


@pytest.mark.parametrize(("change", "sentence"), [
    ({"schema": "relit.scan/1"}, 'schema: is "relit.scan/1", this program reads'),
    ({"scans": []}, "scans: has 0 entries, needs 1 or more"),
    ({"turntable": {"axis_point_m": [0, 0, 0], "axis": [0, 0, 0]}}, "turntable.axis: has zero length"),
])
def test_what_is_no_scan_set_is_refused(tmp_path, change, sentence):
    with pytest.raises(ManifestError, match=r"scan-set\.json: ") as caught:
        read(tmp_path, record(scan(), **change) | change)
    assert sentence in str(caught.value)
