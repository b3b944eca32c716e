"""Prepared scans: what of their files is in memory."""

from pathlib import Path

import numpy as np
import pytest

from service.scans.fusion.range_images import prepare_scan
from service.scans.read import read_scan
from stage.sets.scan_set import read_scan_set
from tests.scenes.statue import turntable, write_scans

STATUS = Path("/proc/self/status")
SHAPE = 256, 320
"""As large that the arrays, some 50 bytes a pixel, are far more than what the kernel counts late."""


def mapped_mib() -> float:
    """Memory of mapped files that this process holds."""
    return next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if line.startswith("RssFile")) / 1024


@pytest.mark.long
@pytest.mark.skipif(not STATUS.exists(), reason="memory is told by /proc")
def test_what_is_released_leaves_memory_and_can_be_read_again(tmp_path):
    file, listed = read_scan_set(write_scans(tmp_path / "scans", turntable(2, SHAPE[::-1])))
    (tmp_path / "arrays").mkdir()
    scan = prepare_scan(read_scan(file, listed, 0), tmp_path / "arrays")
    before = mapped_mib()
    sums = [float(np.sum(array, dtype=np.float64)) for array in (*scan.image[:5], scan.layers, scan.feather)]
    held = mapped_mib()
    scan.release()
    assert held - before > 3 and mapped_mib() - before < 1
    assert [float(np.sum(array, dtype=np.float64)) for array in (*scan.image[:5], scan.layers, scan.feather)] == sums
