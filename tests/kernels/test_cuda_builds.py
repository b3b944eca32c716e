"""The kernels as CUDA runs them go through the compiler that Warp brings along, on machines without a GPU too.

What the hottest kernels take on an H100 stands in cuda_resources.txt, which `python -m tests.kernels.test_cuda_builds` writes anew: no
number there may grow but that of wide loads, which may not shrink.
"""

import inspect
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import warp as wp

from kernels import ahead
from kernels import device as devices
from tests.kernels.cubin import Resources, resources

pytestmark = pytest.mark.long

devices.names()
OLDEST = min(wp.get_cuda_supported_archs(), default=None)
SINE_DEPOT = {"28"}
"""Bytes of local memory that CUDA's sine takes for angles far beyond a turn, which do not occur."""
TREE_DEPOT = {"surface.nearest._nearest": {"128"}}
"""The nodes that Warp's queries of a mesh have yet to visit, 32 of 4 bytes."""

KERNELS = ahead.every_kernel()
TABLE = Path(__file__).with_name("cuda_resources.txt")
TITLE, *LINES = TABLE.read_text(encoding="utf-8").splitlines()
HOT = {name: Resources(*map(int, numbers)) for name, *numbers, _ in (line.rsplit(maxsplit=len(Resources._fields) + 1) for line in LINES)}
H100 = 90
ROOT = Path(__file__).parents[2]


def test_kernels_are_discovered():
    assert {"photometric.lambertian.lambert._lambert_kernel", "photometric.search.search_kernel.search_kernel",
            "structured.stripe._stripe_kernel",
            "surface.multigrid._smooth_from_zero", "tof.continuous.flying._flying_kernel"} <= KERNELS.keys()
    for module in ahead.modules():
        source = inspect.getsource(module)
        place = module.__name__.removeprefix("kernels.")
        if not hasattr(module, "__path__"):  # a package
            assert bool(re.search(r"wp\.kernel\b", source)) == any(name.startswith(f"{place}.") for name in KERNELS), place


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("name", KERNELS)
def test_kernel_compiles_for_cuda_and_keeps_its_packs_in_registers(name, tmp_path):
    if name in HOT:
        path = compiled(name, tmp_path)
        found, known = resources(path), HOT[name]
        assert found.wide >= known.wide and all(now <= then for now, then in zip(found[:-1], known[:-1], strict=True)), \
            f"{found}, and before {known}: see {TABLE.name}"
    else:
        wp.compile_aot_module(KERNELS[name]().module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
        path, = tmp_path.glob("*.ptx")
        ptx = path.read_text(encoding="latin-1").rstrip("\0")
        # an array indexed at run time would lie in local memory: slow
        assert ".entry" in ptx and set(re.findall(r"__local_depot\d+\[(\d+)\]", ptx)) <= SINE_DEPOT | TREE_DEPOT.get(name, set())
    assert b"_backward" not in path.read_bytes()  # nothing is differentiated


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize(("place", "is_fused"), [("surface.conjugate.", False), ("surface.multigrid.", False), ("surface.slopes.", True)])
def test_the_height_solver_rounds_each_product(place, is_fused, tmp_path):
    """Products fused with sums broke it on a GPU, which rounds as the PTX says; that of other kernels shows what to look for."""
    name = next(name for name in KERNELS if name.startswith(place))
    wp.compile_aot_module(KERNELS[name]().module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
    path, = tmp_path.glob("*.ptx")
    assert (b"fma.rn.f32" in path.read_bytes()) == is_fused


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
def test_kernels_made_ahead_are_what_another_process_looks_for(tmp_path, monkeypatch):
    names = "relight.model.shading._shade_kernel", "surface.multigrid._smooth_from_zero"
    monkeypatch.setattr(ahead, "every_kernel", lambda: {name: KERNELS[name] for name in names})
    made = ahead.build(tmp_path, [86, 90, 90])
    asked = subprocess.run([sys.executable, "-c", f"""
from kernels import ahead, device
for name in {names}:
    print(device.cuda_module(ahead.every_kernel()[name]()).get_module_identifier())
"""], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    wanted = {f"{name}.{end}" for name in asked for end in ("sm86.cubin", "sm90.cubin", "meta")}
    assert len(made) == 4 and {path.name for path in tmp_path.iterdir()} == wanted
    assert resources(tmp_path / f"{asked[0]}.sm90.cubin").registers == HOT[names[0]].registers


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
def test_an_interrupted_build_leaves_whole_files_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(ahead, "every_kernel", lambda: {name: KERNELS[name] for name in ("surface.multigrid._smooth_from_zero",)})
    told = []

    def interrupt(*counts):
        told.append(counts)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ahead.build(tmp_path, [86, 90], interrupt)
    assert told == [(1, 2)] and {path.suffix for path in tmp_path.iterdir()} == {".cubin", ".meta"}


def compiled(name: str, folder: Path) -> Path:
    """Return the file of the kernels of a Warp module, compiled for an H100."""
    wp.compile_aot_module(KERNELS[name]().module, arch=H100, module_dir=folder, use_ptx=False)
    path, = folder.glob("*.cubin")
    return path


def write_table() -> None:
    """Write the table of the kernels that it names anew."""
    with tempfile.TemporaryDirectory() as folder:
        taken = {name: resources(compiled(name, Path(tempfile.mkdtemp(dir=folder)))) for name in HOT}
    lines = [f"{name:55s} {' '.join(f'{number:4d}' for number in (*found, found.warps))}" for name, found in taken.items()]
    TABLE.write_text("\n".join([TITLE, *lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    write_table()
