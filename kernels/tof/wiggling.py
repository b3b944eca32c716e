"""Harmonic (wiggling) correction: a light source that is not a pure cosine bends the phase, and a table holds the error at each phase.

Source: Lindner and Kolb, "Lateral and depth calibration of PMD-distance sensors", ISVC 2006.
"""


import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.tof.continuous import Correlation

ENTRIES = 512
"""Number of entries in the table: between two of them, the eighth harmonic of a correction departs from a straight line by less than 0.2 %
of its amplitude."""

wp.set_module_options({"enable_backward": False})


def sample_harmonics(cosines: np.ndarray, sines: np.ndarray) -> np.ndarray:
    """Return Σ_h cosines[h]·cos hφ + sines[h]·sin hφ at ENTRIES phases.

    Args:
        cosines, sines: [H] radians, h from 0.

    Returns:
        [ENTRIES] float64 radians, phases k · 2π / ENTRIES.
    """
    angle = np.arange(ENTRIES)[:, None] * (2 * np.pi / ENTRIES) * np.arange(len(cosines))
    return np.cos(angle) @ np.asarray(cosines, dtype=np.float64) + np.sin(angle) @ np.asarray(sines, dtype=np.float64)


def straighten(found: Correlation, table: np.ndarray) -> Correlation:
    """Correct each phase by the table's value at it.

    Args:
        found: phases as measured.
        table: [frequency, entries] radians by measured phase, evenly spaced over the turn; interpolated linearly.

    Returns:
        The same with other phases, 0…2π; on the device.

    Raises:
        ArrayError: the table has another number of frequencies, or is not finite.

    Source:
        Lindner, Kolb, "Lateral and depth calibration of PMD-distance sensors", ISVC 2006 (the table); here harmonics of the phase.
    """
    if table.ndim != 2 or len(table) != len(found.modulation_hz):
        raise ArrayError(f"the table is {table.shape}, there are {len(found.modulation_hz)} frequencies: give [frequency, entries]")
    if not np.isfinite(table).all():
        raise ArrayError("the table has values that are not finite: measure it anew")
    device = found.phase.device
    straight = wp.zeros_like(found.phase)
    devices.launch(_straighten_kernel, found.phase.shape[1],
                   [found.phase, wp.array(table, dtype=wp.float32, device=device)], [straight],
                   device=str(device))
    return found._replace(phase=straight)


@wp.kernel(module="unique")
def _straighten_kernel(first: int,
                       phase: wp.array2d(dtype=wp.float32),  # [F, pixel]
                       table: wp.array2d(dtype=wp.float32),  # [F, entries]
                       # outputs
                       straight: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    entries = table.shape[1]
    for f in range(table.shape[0]):
        at = phase[f, p] * float(entries) / (2.0 * wp.pi)
        before = wp.floor(at)
        part = at - before
        k = int(before) % entries
        angle = phase[f, p] - (table[f, k] * (1.0 - part) + table[f, (k + 1) % entries] * part)
        straight[f, p] = angle - 2.0 * wp.pi * wp.floor(angle / (2.0 * wp.pi))
