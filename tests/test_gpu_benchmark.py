"""benchmarks.gpu, which anyone with a card can run: it needs no library but Warp and NumPy, and says in one sentence what is missing."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import gpu
from kernels import device as devices

HOME = Path(__file__).parents[1]


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=HOME, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.long
def test_it_needs_only_warp_and_numpy():
    """Importing it loads none of the packages that the rest of relit needs."""
    others = ("OpenEXR", "OpenImageIO", "cv2", "fastapi", "pxr", "pydantic", "scipy", "service", "stage", "typer")
    said = python("-c", f"import sys, benchmarks.gpu; print([name for name in {others!r} if name in sys.modules])")
    assert (said.stdout.strip(), said.stderr) == ("[]", "")


@pytest.mark.long
@pytest.mark.skipif("cuda:0" in devices.names(), reason="there is a GPU")
def test_a_machine_without_a_gpu_is_told_so():
    """The benchmark runs as a program: Warp's own words about the driver are not to be seen."""
    said = python("-m", "benchmarks.gpu")
    assert said.returncode == 1 and "cuda:0 is not on this machine" in said.stderr
    assert len(said.stderr.strip().splitlines()) == 1


def test_the_table_has_a_row_for_each_kind_of_work(monkeypatch, capsys):
    monkeypatch.setattr(gpu, "SIZES", {"cpu": (64, 16)})
    monkeypatch.setattr(gpu, "REPEATS", 1)
    monkeypatch.setattr(sys, "argv", ["gpu", "--device", "cpu", "--no-tests"])
    assert gpu.main() == 0
    shown = capsys.readouterr().out
    works = "copy", "relight, 1 frame", "relight, 32 frames", "`lambert`", "`robust`", "`svbrdf`", "phase", "time-of-flight", "height"
    assert all(work in shown for work in works)
