"""The products on another device than the CPU: CUDA where present, or the emulated device (`--device-emulated`), where what each stage asks
of the device is what device_counts.txt says.

A change that asks for more or less writes the table anew: python -m tests.device_ways.
"""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.device_asked import asked_rows
from kernels import ahead
from kernels import device as devices
from tests import emulated_device
from tests.device_ways import SIDES, WAYS, Counting, count, read, results, run

SMALL, *LARGE = SIDES
ITERATED = "diagnosis", "height", "surface", "start"
"""Stages whose solvers stop at a residual: how many iterations they take depends on the last bits of the processor, and so do all counts
but the bytes uploaded."""
SLACK = 0.25
"""Part by which such a count may differ: some iterations more or fewer of the dozens that a solver takes."""


@pytest.fixture(autouse=True)
def only_where_it_is(device):
    if device == "cpu":
        pytest.skip("compares another device with the CPU")


def compare(rows, way, side):
    """Compare what the stages of a way asked with the table."""
    known = [row for row in read() if (row.way, row.side) == (way, side)]
    assert [row._replace(counts=()) for row in rows] == [row._replace(counts=()) for row in known]
    for row, wanted in zip(rows, known, strict=True):
        for name, found, expected in zip(emulated_device.COUNTED, row.counts, wanted.counts, strict=True):
            slack = SLACK * expected if row.stage in ITERATED and name != "up" else 0
            assert abs(found - expected) <= slack, f"{row.stage}: {name}"


@pytest.mark.parametrize("way", WAYS)
def test_a_product_finds_what_it_finds_on_the_cpu(way, device, tmp_path):
    """Lanes of a pack stop their iterations together, and packs differ in width: a value in a hundred may be off by 1e-3 of the largest, of
    what says how certain others are by 1e-2. An H200, which rounds products with sums only once, was off by at most 7e-3 there: under near
    lamps without noise σ is that of rounding itself."""
    captured = WAYS[way].write(tmp_path, SMALL)
    run(way, tmp_path, tmp_path / "cpu", "cpu", Counting())
    emulated_device.loaded.clear()
    rows = count(way, SMALL, captured, tmp_path, tmp_path / "out", device)
    known, found = results(tmp_path / "cpu"), results(tmp_path / "out")
    assert known and known.keys() == found.keys()
    for layer, values in known.items():
        off = np.abs(values.astype(float) - found[layer])
        slack = 1e-2 if "sigma" in layer or "confidence" in layer else 1e-3
        assert np.mean(off > slack * np.abs(values).max()) <= 0.01, layer
    if emulated_device.installed():
        compare(rows, way, SMALL)
        made_ahead = {devices.cuda_module(make()).get_module_identifier() for make in ahead.every_kernel().values()}
        assert emulated_device.loaded <= made_ahead  # as found for CUDA before a product asks


@pytest.mark.parametrize("side", LARGE)
@pytest.mark.parametrize("way", WAYS)
def test_what_a_larger_scene_asks_of_the_device(way, side, device, tmp_path):
    if not emulated_device.installed():
        pytest.skip("counted on the emulated device")
    compare(count(way, side, WAYS[way].write(tmp_path, side), tmp_path, tmp_path / "out", device), way, side)


def test_the_figures_per_megapixel_are_those_of_the_counts(device):
    page = (Path(__file__).parents[1] / "docs" / "figures.md").read_text(encoding="utf-8")
    section = page.partition("## Asked of a device\n\n")[2]
    assert section.startswith("\n".join(asked_rows())), "python -m benchmarks.figures --only asked writes it anew"
