"""What the projector shows for a manifest entry: the entry is the definition, the image follows from it.

Convention: u is continuous along the axis of the code, 0 at the outer edge of the first pixel; pixel c has its centre at c + 0.5.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stage.pattern import BinaryPattern, KaryPattern, ModulatedPattern, Pattern, PhasePattern, RampPattern, UniformPattern, XorPattern


class PatternSet(NamedTuple):
    """Frames to project, in order."""

    patterns: tuple[Pattern, ...]  # manifest entries
    images: np.ndarray  # [frames, rows, cols] or, with a colour code, [frames, rows, cols, 3] float32, 0…1, linear light


def gray_of(code: np.ndarray) -> np.ndarray:
    """The reflected binary code (Gray, US patent 2632058) of whole numbers."""
    return code ^ (code >> 1)


def digits_of(code: np.ndarray, base: int, digits: int, *, reflected: bool) -> np.ndarray:
    """Base-k digits, least significant first.

    Args:
        code: [n] whole numbers from 0.
        base: k.
        digits: how many; more significant ones are cut off.
        reflected: a digit t becomes k - 1 - t where the more significant digits, as shown, add up to an odd number: neighbours
            then differ in one digit, by one (k-ary Gray code). With odd k the plain digits above add up to odd at the same time.

    Returns:
        [digits, n].
    """
    plain = np.stack([code // base**d % base for d in range(digits)])
    if not reflected:
        return plain
    higher = np.zeros_like(code)
    shown = np.empty_like(plain)
    for digit in reversed(range(digits)):
        shown[digit] = np.where(higher % 2 == 1, base - 1 - plain[digit], plain[digit])
        higher = higher + shown[digit]
    return shown


def profile(pattern: Pattern, u: np.ndarray, extent: int) -> np.ndarray:
    """Levels along the axis of the code.

    Args:
        pattern: any entry but `modulated`, which varies across the axis too.
        u: [n] continuous projector coordinates.
        extent: pixels of the projector along the axis.

    Returns:
        [n], or [n, 3] for colours, float64, 0…1.
    """
    match pattern:
        case UniformPattern():
            return np.full(len(u), 1.0 if pattern.code == "white" else 0.0)
        case RampPattern():
            return u / extent if pattern.direction == "up" else 1 - u / extent
        case PhasePattern():
            return (1 + np.cos(2 * np.pi * (u / pattern.period_px - pattern.step / pattern.steps))) / 2
        case ModulatedPattern():
            raise ValueError("a modulated pattern has no profile: it varies along both axes")
    code = np.floor(u / pattern.stripe_px).astype(np.int64)
    match pattern:
        case KaryPattern():
            digit = digits_of(code, pattern.base, pattern.digits, reflected=pattern.reflected)[pattern.digit]
            return np.array(pattern.levels if pattern.levels is not None else pattern.colors, dtype=np.float64)[digit]
        case BinaryPattern():
            bit = (gray_of(code) if pattern.code == "gray" else code) >> pattern.bit & 1
        case XorPattern():
            gray = gray_of(code)
            bit = gray >> pattern.bit & 1
            if pattern.bit > pattern.base_bit:
                bit ^= gray >> pattern.base_bit & 1
    return (bit ^ int(pattern.inverse)).astype(np.float64)


def draw(pattern: Pattern, resolution: tuple[int, int]) -> np.ndarray:
    """The image of one frame.

    Args:
        pattern: the manifest entry.
        resolution: width and height of the projector.

    Returns:
        [rows, cols] or [rows, cols, 3] float32, 0…1, linear light.
    """
    width, height = resolution
    column = getattr(pattern, "axis", "column") == "column"
    along, across = (width, height) if column else (height, width)
    centres = np.arange(along) + 0.5
    if isinstance(pattern, ModulatedPattern):
        wave = (1 + np.cos(2 * np.pi * (centres / pattern.period_px - pattern.step / pattern.steps))) / 2
        carrier = (1 + np.cos(2 * np.pi * ((np.arange(across) + 0.5) / pattern.carrier_period_px
                                           - pattern.carrier_step / pattern.carrier_steps))) / 2
        image = np.outer(carrier, wave) if column else np.outer(wave, carrier)
        return image.astype(np.float32)
    line = profile(pattern, centres, along).astype(np.float32)
    shape = (height, width, *line.shape[1:])
    return np.broadcast_to(line[None, :] if column else line[:, None], shape).copy()


def draw_all(patterns: Sequence[Pattern], resolution: tuple[int, int]) -> PatternSet:
    """The images of several frames; grey ones are repeated in three channels beside colours.

    Raises:
        ValueError: no pattern.
    """
    if not patterns:
        raise ValueError("there is no pattern to draw")
    images = [draw(pattern, resolution) for pattern in patterns]
    if any(image.ndim == 3 for image in images):
        images = [image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1) for image in images]
    return PatternSet(tuple(patterns), np.stack(images))
