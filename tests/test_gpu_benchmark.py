"""benchmarks.gpu, which anyone with a card can run: it needs no library but Warp and NumPy, and says in one sentence what is missing."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gpu import __main__ as gpu
from benchmarks.gpu import checks, work
from kernels import device as devices
from tests import emulated_device

HOME = Path(__file__).parents[1]
FEW = 32
"""Pixels of the smallest batch."""
ALONE = """
import sys
from importlib.machinery import BuiltinImporter, FrozenImporter, PathFinder

class Few(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        known = {"warp", "numpy", "kernels", "benchmarks", *sys.stdlib_module_names}
        return super().find_spec(name, path, target) if name.partition(".")[0] in known else None

sys.meta_path[:] = BuiltinImporter, FrozenImporter, Few
from benchmarks.gpu import __main__ as gpu, work
work.PATTERN_PIXELS, work.CPU_BYTES, work.REPEATS = 1024, 1 << 20, 1
sys.exit(gpu.main(["--device", "cpu"]))
"""


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=HOME, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.long
def test_it_runs_with_warp_and_numpy_alone():
    """In a process in which no other package can be imported."""
    said = python("-c", ALONE)
    assert (said.returncode, said.stderr) == (0, "")
    assert "torch is not installed" in said.stdout and "`svbrdf`" in said.stdout


@pytest.mark.long
@pytest.mark.skipif("cuda:0" in devices.names(), reason="there is a GPU")
def test_a_machine_without_a_gpu_is_told_so():
    """The benchmark runs as a program: Warp's own words about the driver are not to be seen."""
    said = python("-m", "benchmarks.gpu")
    assert said.returncode == 1 and "cuda:0 is not on this machine" in said.stderr
    assert len(said.stderr.strip().splitlines()) == 1


CARD, CONTEXT = 8e9, 1e9
"""Bytes of a small card, and what CUDA and the kernels' code take of them."""
HOST, SYSTEM = 16e9, 4e9
"""Bytes of a small host, and what the system, Python and Warp take of them."""


def test_it_fits_a_card_of_8_gb_and_a_host_of_16(device, monkeypatch):
    """Bytes that the table holds at one time, a line through those of few pixels, continued to the pixels of its batches on the card and,
    on the host, of the largest card."""
    if not emulated_device.installed():
        pytest.skip("counted on the emulated device")
    monkeypatch.setattr(emulated_device, "MEMORY", int(CARD))
    monkeypatch.setattr(emulated_device, "TWICE", False)
    on_card = work.batch_pixels(device, work.STACK_BYTES, work.MOST_PIXELS)
    sampled = min(devices.batch_bytes(device, work.CPU_BYTES) // work.SAMPLE_BYTES, work.MOST_SAMPLED)
    most, most_sampled = work.MOST_PIXELS, work.MOST_SAMPLED
    for name, value in {"PATTERN_PIXELS": FEW, "REPEATS": 1}.items():
        monkeypatch.setattr(work, name, value)

    def held(pixels: int, general: int) -> np.ndarray:
        monkeypatch.setattr(work, "MOST_PIXELS", pixels)
        monkeypatch.setattr(work, "MOST_SAMPLED", general)
        emulated_device.memory.peak = emulated_device.memory.held
        tracemalloc.start()
        try:
            work.measure(device)
            return np.array([emulated_device.memory.peak, tracemalloc.get_traced_memory()[1]], dtype=float)
        finally:
            tracemalloc.stop()

    held(FEW, FEW)  # compiles
    more, few = held(FEW, 4 * FEW), held(FEW, FEW)  # here the general solver holds most
    wide, wider = held(64 * FEW, FEW), held(128 * FEW, FEW)  # and here the stack
    of_sample, of_stack = (more - few) / (3 * FEW), (wider - wide) / (64 * FEW)
    assert of_stack[0] > 2 * work.STACK_BYTES and of_sample[0] > work.SAMPLE_BYTES
    assert few[0] + max(of_stack[0] * on_card, of_sample[0] * sampled) <= CARD - CONTEXT
    assert few[1] + max(of_stack[1] * most, of_sample[1] * most_sampled) <= HOST - SYSTEM


def test_the_table_has_a_row_for_each_kind_of_work(device, monkeypatch, capsys):
    for name, value in {"PATTERN_PIXELS": 128, "CPU_BYTES": 1 << 20, "MOST_PIXELS": 256, "MOST_SAMPLED": 128, "REPEATS": 1}.items():
        monkeypatch.setattr(work, name, value)
    assert gpu.main(["--device", device]) == 0
    shown = capsys.readouterr().out
    assert len(checks.CHECKS) >= 20 and f"{len(checks.CHECKS)} kernels agree with NumPy" in shown
    works = "copy", "upload", "relight, 1 frame", "relight, 32 frames", "`lambert`", "`robust`", "`svbrdf`", "phase", "flight", "height"
    assert all(work in shown for work in works)


def test_no_speed_is_told_of_a_wrong_kernel(device, monkeypatch, capsys):
    """A sum that lacks its last light."""
    plain = checks.combine

    def without_last(band, weights):
        lacking = weights.copy()
        lacking[:, checks.LIGHTS - 1] = 0
        return plain(band, lacking)

    monkeypatch.setattr(checks, "combine", without_last)
    assert gpu.main(["--device", device]) == 1
    outcome = capsys.readouterr()
    assert outcome.out == "" and "one_frame: off by" in outcome.err and f"1 of {len(checks.CHECKS)} kernels" in outcome.err
