"""The energy of the samples of a lat-long map, summed over lights, for many rotations of the map.

The parts of a sample that go to different lights are found once for all rotations that differ by whole columns of samples; each frame then
takes them to its own columns of the map. Sums are taken on the host in float64, one after another for each light, so that the parts of a
sample, whichever lights they go to, are the whole of it, and so that a frame does not depend on the others, to the last bit.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.relight.directions.latlong import SampleGrid, Turn, cut, shared_turns
from kernels.relight.weights.borders import Shares

HOST = "cpu"
"""The device of the sums: a thread sums all parts of one light, and a GPU would need thousands of threads."""


class LightEnergy(NamedTuple):
    """Energy of an environment that each light stands for."""

    energy: np.ndarray  # [frames, lights, 3] float64: ∫ w L dω, W/m² of the map's unit; w is the light's part of each direction
    solid_angle: np.ndarray  # [frames, lights] float64 steradians: ∫ w dω


class _Parts(NamedTuple):
    """Parts of samples, none of them empty: those of the first light, then those of the next."""

    begin: np.ndarray  # [lights + 1] int32: where the parts of each light begin
    row: np.ndarray  # [n] int32 of the sample
    column: np.ndarray  # [n] int32 of the sample
    share: np.ndarray  # [n] float64


def gather(environment: np.ndarray, rotations: np.ndarray, lights: int,
           split: Callable[[np.ndarray, SampleGrid], Iterable[Shares]]) -> LightEnergy:
    """Sum the energy of the samples of a map [rows, cols, 3], turned by rotations [frames, 3, 3], over lights.

    Args:
        split: (rotation, band) → which parts of the band's samples go where; the shares of a sample add up to one.
    """
    energy, areas = np.zeros((len(rotations), lights, 3)), np.zeros((len(rotations), lights))
    for band in cut(*environment.shape[:2]).bands():
        amounts = np.repeat(environment[band.texel_row].astype(np.float64), band.across, axis=1) * band.solid_angle[:, None, None]
        given = wp.array(amounts, dtype=wp.vec3d, device=HOST)
        for turn in shared_turns(rotations, len(band.azimuth)):
            parts, frames = _sorted(split(turn.rotation, band), len(band.azimuth), lights), list(turn.frames)
            light = np.repeat(np.arange(lights), np.diff(parts.begin))
            areas[frames] += np.bincount(light, weights=band.solid_angle[parts.row] * parts.share, minlength=lights)
            energy[frames] += _sums(given, parts, turn)
    return LightEnergy(energy, areas)


def _sorted(shares: Iterable[Shares], columns: int, lights: int) -> _Parts:
    """Return the parts of samples of a grid with this number of columns, sorted by light."""
    found = []
    for part in shares:
        kept = np.flatnonzero(part.share)
        sample = kept if isinstance(part.sample, slice) else part.sample[kept]
        found.append((part.light[kept].astype(np.int32), sample.astype(np.int32), part.share[kept].astype(np.float64)))
    light, sample, share = (np.concatenate(values) for values in zip(*found, strict=True))
    order = np.argsort(light, kind="stable")
    begin = np.concatenate([[0], np.cumsum(np.bincount(light, minlength=lights))])
    return _Parts(begin.astype(np.int32), *np.divmod(sample[order], np.int32(columns)), share[order])


def _sums(amounts: wp.array, parts: _Parts, turn: Turn) -> np.ndarray:
    """Return [frames, lights, 3] float64 the energy of each light in each frame of a turn, of samples [rows, cols] vec3d on the host."""
    shift = wp.array(np.array(turn.columns) % amounts.shape[1], dtype=wp.int32, device=HOST)
    energy = wp.zeros((len(parts.begin) - 1, len(turn.frames)), dtype=wp.vec3d, device=HOST)
    inputs = [wp.array(values, dtype=kind, device=HOST)
              for values, kind in zip(parts, (wp.int32, wp.int32, wp.int32, wp.float64), strict=True)]
    devices.launch(_sum_kernel, len(energy), [amounts, *inputs, shift], [energy], device=HOST, uneven=True)
    return to_numpy(energy).swapaxes(0, 1)


@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
def _sum_kernel(first: int,
                amounts: wp.array2d(dtype=wp.vec3d),  # [rows, cols]
                begin: wp.array(dtype=wp.int32),  # [lights + 1]
                row: wp.array(dtype=wp.int32),  # [parts]
                column: wp.array(dtype=wp.int32),  # [parts]
                share: wp.array(dtype=wp.float64),  # [parts]
                shift: wp.array(dtype=wp.int32),  # [frames] columns
                # outputs
                energy: wp.array2d(dtype=wp.vec3d)):  # [lights, frames], 0 at the start
    light = first + wp.tid()
    columns = amounts.shape[1]
    for part in range(begin[light], begin[light + 1]):
        r = row[part]
        c = column[part]
        given = share[part]
        for frame in range(shift.shape[0]):
            at = c + shift[frame]
            if at >= columns:
                at -= columns
            energy[light, frame] = energy[light, frame] + given * amounts[r, at]
