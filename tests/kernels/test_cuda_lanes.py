"""The kernels that take one pixel a thread on CUDA, in each of the variants that they close over."""

import pytest
import warp as wp

from kernels import device as devices
from kernels.photometric import hypotheses, refine, response_table
from kernels.photometric.lobes import direction_lobes, direction_reflectance
from kernels.photometric.material_kernel import material_kernel
from kernels.photometric.samples import LANES_CUDA
from kernels.photometric.tabulated_lobes import tabulated_lobes, tabulated_reflectance

devices.names()
OLDEST = min(wp.get_cuda_supported_archs(), default=None)
KERNELS = {
    "search, directions": lambda: hypotheses._search_kernel(LANES_CUDA, direction_lobes(LANES_CUDA), 5, 12),
    "search, table": lambda: hypotheses._search_kernel(
        LANES_CUDA, tabulated_lobes(LANES_CUDA, response_table.SEARCH_LOBES), 5, 30),
    "search, one measured lobe": lambda: hypotheses._search_kernel(LANES_CUDA, tabulated_lobes(LANES_CUDA, 1), 5, 30),
    "material, directions": lambda: material_kernel(LANES_CUDA, direction_reflectance(LANES_CUDA), False),
    "material, table": lambda: material_kernel(LANES_CUDA, tabulated_reflectance(LANES_CUDA), True),
    "refinement": lambda: refine._refine_kernel(LANES_CUDA, direction_reflectance(LANES_CUDA)),
    "table": lambda: response_table._table_kernel(LANES_CUDA),
}


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("name", KERNELS)
def test_kernel_compiles_for_cuda_and_keeps_its_sums_in_registers(name, tmp_path):
    wp.compile_aot_module(KERNELS[name]().module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
    ptx, = (path.read_text(encoding="latin-1") for path in tmp_path.glob("*.ptx"))
    assert ".entry" in ptx and "__local_depot" not in ptx  # an array indexed at run time would lie in local memory: slow
