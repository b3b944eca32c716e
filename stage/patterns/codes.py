"""All pattern codes in one table, the images of their frames, and which frames of a capture make up a code.

A code is one module of this package, which holds: its manifest entry (`...Pattern`: what one frame shows, and its level at each place), its
frames put together (`...Code`, collected from a capture), and the frames to project (`..._patterns`). `CODES` names them; the unions
`Pattern` and `Code` repeat its two columns for pydantic and the type checker. How a code is decoded, asked for with `relit patterns` and
planned stands in service/depth/patterns/codes.py.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from stage.errors import ManifestError
from stage.patterns.base import UniformPattern
from stage.patterns.binary import BinaryCode, BinaryPattern, XorPattern
from stage.patterns.kary import KaryCode, KaryPattern
from stage.patterns.modulated import ModulatedCode, ModulatedPattern
from stage.patterns.phase import PhaseCode, PhasePattern
from stage.patterns.ramp import RampCode, RampPattern

Pattern = Annotated[BinaryPattern | KaryPattern | RampPattern | PhasePattern | XorPattern | ModulatedPattern | UniformPattern,
                    Field(discriminator="code")]
"""The manifest entry of one frame, told apart by `code`."""

Code = BinaryCode | KaryCode | RampCode | PhaseCode | ModulatedCode
"""The frames of a capture that together code one axis."""

CODES: dict[type, Callable[[Any], Code]] = {
    BinaryPattern: BinaryCode.collect,
    XorPattern: BinaryCode.collect,
    KaryPattern: KaryCode.collect,
    RampPattern: RampCode.collect,
    PhasePattern: PhaseCode.collect,
    ModulatedPattern: ModulatedCode.collect,
}
"""Manifest entry → how the frames with such entries become a code."""


class Collected(NamedTuple):
    """The codes of a capture, and its frames under even light, as indices into the list of frames."""

    codes: tuple[Code, ...]
    white: int | None
    black: int | None


def draw(pattern: Pattern, resolution: tuple[int, int]) -> np.ndarray:
    """Return the image that the projector shows for a manifest entry: the entry is the definition, the image follows from it.
    Returns [rows, cols] or, in colours, [rows, cols, 3] float32, 0…1, linear light.

    Convention: coordinates are continuous, 0 at the outer edge of the first pixel; pixel c has its centre at c + 0.5. A code's level is
    taken at u along its axis and v across it.
    """
    width, height = resolution
    x, y = np.arange(width)[None, :] + 0.5, np.arange(height)[:, None] + 0.5
    column = getattr(pattern, "axis", "column") == "column"
    level = pattern.level(x, y, width) if column else pattern.level(y, x, height)
    return np.broadcast_to(level.astype(np.float32), (height, width, *level.shape[2:])).copy()


def collect(patterns: Sequence[Pattern | None]) -> Collected:
    """Sort frames into codes, whatever their order; `patterns`: the entry of each frame; None for frames that are something else."""
    first: dict[Pattern, int] = {}
    for index, pattern in enumerate(patterns):
        if pattern is None:
            continue
        if pattern in first:
            raise ManifestError(f"frames {first[pattern]} and {index} show one pattern ({pattern.describe()}): keep one, or their mean")
        first[pattern] = index
    groups: dict[tuple[object, ...], dict[Pattern, int]] = {}
    for pattern, index in first.items():
        if not isinstance(pattern, UniformPattern):
            key = (pattern.code, pattern.axis, pattern.period_px if isinstance(pattern, ModulatedPattern) else None)
            groups.setdefault(key, {})[pattern] = index
    white, black = (next((index for pattern, index in first.items() if pattern.code == name), None) for name in ("white", "black"))
    return Collected(tuple(CODES[type(next(iter(group)))](group) for group in groups.values()), white, black)
