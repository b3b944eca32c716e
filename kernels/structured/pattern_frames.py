"""Frames under projected patterns, on a device: readings as packs, which of them saturate, and how noisy they are."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, band_of, pack_type


class NoiseModel(NamedTuple):
    """Variance of a reading I: read² + gain · max(I, 0), in the unit of the images."""

    read: float
    """Standard deviation of a reading in the dark: read noise and quantisation."""
    gain: float
    """Gain of photon noise: full scale divided by the electrons that fill a pixel."""

    def variance(self, readings: np.ndarray) -> np.ndarray:
        """Return the variance of readings of any shape."""
        return self.read**2 + self.gain * np.maximum(readings, 0)


def require_frames(frames: Band, *numbers: int | None, channels: int = 1) -> None:
    """Refuse frames that do not exist or are taken twice, or images of another number of channels."""
    have = frames.values.shape[0] // frames.frame_count
    if have != channels:
        raise ArrayError(f"the frames have {have} channels, this decoder takes {channels}")
    given = [number for number in numbers if number is not None]
    for number in given:
        if not 0 <= number < frames.frame_count:
            raise ArrayError(f"frame {number} does not exist: there are {frames.frame_count} (0 to {frames.frame_count - 1})")
    if len(set(given)) < len(given):
        twice = next(number for number in given if given.count(number) > 1)
        raise ArrayError(f"frame {twice} is given for two patterns: every pattern has a frame of its own")


def saturation_masks(frames: Band, *sets: Sequence[int | None]) -> wp.array:
    """Return the bits of `frames.saturated` that belong to some frames: [⌈frames / 8⌉] int32, or a row for each of several sets."""
    masks = np.zeros((len(sets), frames.saturated.shape[0]), dtype=np.int32)
    for row, numbers in zip(masks, sets, strict=True):
        for number in numbers:
            if number is not None:
                row[number // 8] |= 1 << number % 8
    return wp.array(masks if len(sets) > 1 else masks[0], dtype=wp.int32, device=frames.device)


def upload(values: np.ndarray, saturated: np.ndarray | None = None, *, device: str) -> Band:
    """Lay frames out on the device; on the CPU nothing is copied when the pixels divide into packs and lie without gaps.
    `values`: [frames, pixels] or [frames, channels, pixels] float32, linear. `saturated`: [⌈frames / 8⌉, pixels] uint8 bits: frame f is
    bit f % 8 of byte f // 8; None when no reading saturates."""
    if values.ndim not in (2, 3) or values.dtype != np.float32 or 0 in values.shape:
        raise ArrayError(f"values are {values.dtype} {values.shape}: give [frames, pixels] or [frames, channels, pixels] float32")
    count, channels, pixels = len(values), 1 if values.ndim == 2 else values.shape[1], values.shape[-1]
    groups = -(-count // 8)
    if saturated is None:
        saturated = np.zeros((groups, pixels), dtype=np.uint8)
    if saturated.shape != (groups, pixels) or saturated.dtype != np.uint8:
        raise ArrayError(f"saturated is {saturated.dtype} {saturated.shape}: give uint8 {(groups, pixels)}, a bit for each frame")
    return band_of(values.reshape(count * channels, pixels), saturated, frame_count=count, device=device)


def saturated_bits(saturated: np.ndarray) -> np.ndarray:
    """Return [⌈frames / 8⌉, pixels] uint8 bits of [frames, pixels] bool."""
    return np.packbits(np.pad(saturated, ((0, -len(saturated) % 8), (0, 0))), axis=0, bitorder="little")


@once
def cut_in(pack: int) -> Any:
    """Return the Warp function that gives the bits of the frames of a mask that saturate at each pixel of a pack; 0 where none does."""
    int_pack, byte_pack, load_byte = pack_type(pack, wp.int32), pack_type(pack, wp.uint8), pack_load(pack, wp.uint8)

    @wp.func
    def cut_of(saturated: wp.array2d(dtype=byte_pack), masks: wp.array(dtype=int), p: int):
        cut = int_pack()
        for group in range(masks.shape[0]):
            flags = load_byte(saturated, group, p)
            mask = masks[group]
            for k in range(pack):
                cut[k] = cut[k] | (int(flags[k]) & mask)
        return cut

    return cut_of


def check_noise(noise: NoiseModel) -> None:
    """Refuse a noise model without read noise, with which the weight of a dark reading would be infinite, or with a negative gain."""
    if not (np.isfinite(noise).all() and noise.read > 0 and noise.gain >= 0):
        raise ArrayError(f"the noise is read {noise.read:g}, gain {noise.gain:g}: give a read noise above 0 and a gain of 0 or more")


def check_stripes(extent: float, stripe_px: float) -> None:
    """Refuse stripes or a projector without width."""
    if not (extent > 0 and stripe_px > 0):
        raise ArrayError(f"the projector has {extent:g} px, a stripe {stripe_px:g}: give both above 0")
