"""The kernels as CUDA runs them go through the compiler that Warp brings along, on machines without a GPU too."""

import re
from functools import partial

import pytest
import warp as wp

from kernels import device as devices
from kernels.device import PACK_CUDA
from kernels.photometric import albedo, gradient, highlight, lambert, moments, near, readings, robust, separation
from kernels.relight import basis, batch, cells, combine, display, guide, near_sum, occlusion, residual, shading, smooth
from kernels.structured import binary, edges, kary, micro, modulated, phase, ramp, stripe, triangulate
from kernels.structured import separation as light_parts
from kernels.structured import unwrap as wraps
from kernels.tof import bilateral, continuous, decide, flying, pileup, returns, times, unwrap, vote, wiggling

devices.names()
OLDEST = min(wp.get_cuda_supported_archs(), default=None)


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("make", [readings._grey_kernel, lambert._lambert_kernel, robust._robust_kernel, albedo._albedo_kernel,
                                  moments._moments_kernel, separation._difference_kernel, separation._colour_kernel,
                                  gradient._diffuse_kernel, highlight._specular_kernel, near._near_kernel,
                                  *(partial(module, near=True) for module in
                                    (lambert._lambert_kernel, robust._robust_kernel, albedo._albedo_kernel)),
                                  combine.register_kernel, batch.register_kernel, cells._nearest_kernel,
                                  basis.gram_kernel, display.encode_kernel, residual.residual_kernel, shading._shade_kernel,
                                  guide._compare_kernel, near_sum._sum_kernel, occlusion._see_kernel,
                                  continuous.decode_kernel, unwrap.unwrap_kernel, vote.vote_kernel, decide.decide_kernel,
                                  wiggling.straighten_kernel, flying.flying_kernel, bilateral.smooth_kernel, bilateral.frame_kernel,
                                  pileup.coates_kernel, returns.returns_kernel, times.times_kernel,
                                  *(partial(binary._stripe_kernel, code=code) for code in ("binary", "gray", "xor")),
                                  partial(binary._stripe_kernel, inverses=False), partial(binary._stripe_kernel, references=False),
                                  kary._kary_kernel, partial(kary._kary_kernel, channels=3), ramp._ramp_kernel,
                                  partial(ramp._ramp_kernel, pair=False), phase._phase_kernel, partial(phase._phase_kernel, ambient=True),
                                  wraps._joint_kernel, wraps._numbered_kernel, micro._micro_kernel, modulated._modulated_kernel,
                                  *(partial(triangulate._kernel, with_u=u, with_v=v) for u, v in ((1, 0), (0, 1), (1, 1))),
                                  lambda pack: stripe._stripe_kernel, light_parts._extremes_kernel, light_parts._swing_kernel,
                                  edges._number_kernel,
                                  lambda pack: edges._edge_kernel(),
                                  lambda pack: smooth._walk_kernel(),
                                  lambda pack: near_sum._weights_kernel()])
def test_kernel_compiles_for_cuda_and_keeps_its_packs_in_registers(make, tmp_path):
    wp.compile_aot_module(make(PACK_CUDA).module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
    ptx, = (path.read_text(encoding="latin-1") for path in tmp_path.glob("*.ptx"))
    assert ".entry" in ptx and "__local_depot" not in ptx  # an array indexed at run time would lie in local memory: slow


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
def test_kernel_with_sine_and_cosine_keeps_the_rest_in_registers(tmp_path):
    """CUDA's sine has 28 bytes of local memory, for angles far beyond a turn, which do not occur."""
    wp.compile_aot_module(highlight._highlight_kernel(PACK_CUDA).module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
    ptx, = (path.read_text(encoding="latin-1") for path in tmp_path.glob("*.ptx"))
    assert ".entry" in ptx and set(re.findall(r"__local_depot\d+\[(\d+)\]", ptx)) <= {"28"}
