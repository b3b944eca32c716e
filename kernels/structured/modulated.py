"""Modulated phase shifting: the direct light of each phase step, by a fine carrier, and then the phase of that.

Under (1 + cos φ_i)/2 · (1 + cos ψ_j)/2 only direct light follows the carrier ψ. Its carrier phase is the same at every step i, so
the steps' responses are projected on the direction of their sum: they keep their sign, and noise does not make dark steps bright.

Source: Chen, Seidel and Lensch, "Modulated phase-shifting for 3D scanning", CVPR 2008, section 4.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, unwritten
from kernels.structured.pattern_frames import NoiseModel, check_noise, cut_in, require_frames, saturation_masks
from kernels.structured.phase import WrappedPhase, add_frame, weights, write_phases_in
from kernels.structured.response import modulated_wave, phase_table, straighten


def decode_modulated(frames: Band, numbers: Sequence[Sequence[int]], *, period_px: float, offset_rad: float = 0.0,
                     response: Sequence[float] | None = None, noise: NoiseModel) -> WrappedPhase:
    """Decode the wrapped phase of one period from direct light alone.

    The phase is as decode_phase gives it; amplitude and offset are those of the direct light; ambient light has cancelled. SHADOWED: no
    direct light. LOW_MODULATION: it does not follow the phase.

    Args:
        frames: linear images of one channel.
        numbers: [steps][carrier steps] frames; both even over a turn.
        offset_rad: phase of the wave at place 0 in the first step.
        response: the projector's light at even levels from 0 to 1, rising; None: linear.

    Raises:
        ArrayError: a frame is missing, does not exist or is given twice; a period that is not above zero.
    """
    check_noise(noise)
    steps, carriers = len(numbers), len(numbers[0]) if numbers else 0
    if steps < 3 or carriers < 3 or any(len(row) != carriers for row in numbers):
        raise ArrayError(f"there are {[len(row) for row in numbers]} carrier frames a step: give three or more for each of three or more "
                         "steps, as many for each")
    if not period_px > 0:
        raise ArrayError(f"the period is {period_px:g} px: give more than 0")
    order = [number for row in numbers for number in row]
    require_frames(frames, *order)
    device = frames.device
    shifts = np.arange(steps) / steps - offset_rad / (2 * np.pi)
    outer, inner = weights(shifts, period_px), weights(np.arange(carriers) / carriers, period_px)
    rows = [unwritten(frames.pixel_count, dtype, device, rows=1) for dtype in (*[wp.float32] * 4, wp.uint8)]
    devices.launch(_modulated_kernel(devices.pack_width(device)), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, order), wp.array(numbers, dtype=wp.int32, device=device),
                    wp.array(outer, dtype=wp.vec3, device=device), wp.array(inner, dtype=wp.vec3, device=device),
                    noise.read**2, noise.gain], [as_packs(row, device) for row in rows], device=device)
    if response is not None:
        wave = modulated_wave(response, inner)
        bend = phase_table((wave - wave.min()) / np.ptp(wave), outer, shifts, period_px)
        straighten(rows, [bend], [0.0], device=device)
    return WrappedPhase(*rows, (float(period_px),), frames.pixel_count, device)


@once
def _modulated_kernel(pack: int) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of, write_phases = cut_in(pack), write_phases_in(pack)

    @wp.kernel(enable_backward=False, module="unique")
    def modulated_kernel(first: int,
                         values: wp.array2d(dtype=float_pack),  # [F, P]
                         saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                         masks: wp.array(dtype=int),  # [F / 8]
                         order: wp.array2d(dtype=int),  # [steps, carrier steps] frames
                         outer: wp.array(dtype=wp.vec3),  # [steps] weights for A, C, S
                         inner: wp.array(dtype=wp.vec3),  # [carrier steps]
                         read_variance: float,
                         gain: float,
                         # outputs
                         phase: wp.array2d(dtype=float_pack),
                         amplitude: wp.array2d(dtype=float_pack),
                         offset: wp.array2d(dtype=float_pack),
                         sigma: wp.array2d(dtype=float_pack),
                         status: wp.array2d(dtype=byte_pack)):
        p = first + wp.tid()
        cut = cut_of(saturated, masks, p)

        # where the carrier stands at this pixel: the same at every step
        cosine, sine = float_pack(), float_pack()
        for step in range(order.shape[0]):
            for carrier in range(order.shape[1]):
                reading = values[order[step, carrier], p]
                c, s = inner[carrier][1], inner[carrier][2]
                for k in range(pack):
                    cosine[k] = cosine[k] + c * reading[k]
                    sine[k] = sine[k] + s * reading[k]
        for k in range(pack):
            over = 1.0 / (wp.sqrt(cosine[k] * cosine[k] + sine[k] * sine[k]) + 1.0e-30)
            cosine[k] = cosine[k] * over
            sine[k] = sine[k] * over

        mean, along, across = float_pack(), float_pack(), float_pack()
        vaa, vcc, vss, vcs = float_pack(), float_pack(), float_pack(), float_pack()
        for step in range(order.shape[0]):
            direct, variance = float_pack(), float_pack()
            for carrier in range(order.shape[1]):
                reading = values[order[step, carrier], p]
                c, s = inner[carrier][1], inner[carrier][2]
                for k in range(pack):
                    w = c * cosine[k] + s * sine[k]
                    direct[k] = direct[k] + w * reading[k]
                    variance[k] = variance[k] + w * w * (read_variance + gain * wp.max(reading[k], 0.0))
            row = outer[step]
            for k in range(pack):
                add_frame(direct[k], variance[k], row[0], row[1], row[2],
                          mean[k], along[k], across[k], vaa[k], vcc[k], vss[k], vcs[k])
        write_phases(0, p, cut, mean, along, across, vaa, vcc, vss, vcs, float_pack(), float_pack(),
                     phase, amplitude, offset, sigma, status)

    return modulated_kernel
