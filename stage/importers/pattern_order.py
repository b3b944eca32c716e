"""The patterns of a stack of images in the order in which they were taken: Gray codes and phase shifts of any order.

The orders of SLStudio are those of its codecs (Wilm et al., "SLStudio: Open-source framework for real-time structured light", IPTA 2014).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import radians
from typing import Any

from stage.errors import ManifestError
from stage.patterns.base import digit_count

Entry = dict[str, Any]
"""The entry `pattern` of a frame of the manifest."""

PARTS = ("columns", "rows", "white", "black")
"""The parts of a sequence of a Gray code."""
LOOPS = ("axis", "period", "step")
"""The loops that the order of a stack of phases names."""
AXIS_OF = {"columns": "column", "rows": "row"}


@dataclass(frozen=True, kw_only=True)
class GrayStack:
    """The layout of a stack of a Gray code."""

    sequence: tuple[str, ...] = ("columns", "rows", "white", "black")
    """The order of the parts: members of PARTS, each at most once."""
    inverses: str = "pairs"
    """`pairs`: each image is followed by its inverse; `first`: each image follows its inverse; `blocks`: all images of an axis, then their
    inverses; `none`."""
    fine_first: bool = False
    """True if the finest stripes are shown first; else the coarsest."""
    column_bits: int | None = None
    row_bits: int | None = None
    """Number of images that code the columns and the rows, the finest left out where they are fewer than all; None: all."""

    def entries(self, projector: tuple[int, int]) -> list[Entry]:
        """Return the patterns in the order of the images."""
        if not self.sequence or len(set(self.sequence)) < len(self.sequence) or not set(self.sequence) <= set(PARTS):
            raise ManifestError(f"--sequence {','.join(self.sequence)}: give some of {', '.join(PARTS)}, each once")
        found: list[Entry] = []
        for part in self.sequence:
            if part not in AXIS_OF:
                found.append({"code": part})
                continue
            axis = AXIS_OF[part]
            size, given = (projector[0], self.column_bits) if axis == "column" else (projector[1], self.row_bits)
            found += gray_entries(axis, size, given, inverses=self.inverses, fine_first=self.fine_first)
        return found


def gray_entries(axis: str, size: int, given: int | None, *, inverses: str, fine_first: bool) -> list[Entry]:
    """Return the patterns of one axis of a Gray code.
    `given`: the count of bits, the finest left out; None: all. The others are as of `GrayStack`."""
    whole = digit_count(size, 2)
    bits = whole if given is None else given
    if not 1 <= bits <= whole:
        raise ManifestError(f"--{axis}-bits {bits}: a projector of {size} {axis}s has 1 to {whole} bits")
    stripe = {} if bits == whole else {"stripe_px": 2 ** (whole - bits)}
    order = range(bits) if fine_first else reversed(range(bits))
    plain = [{"code": "gray", "axis": axis, "bit": bit, "bits": bits, **stripe} for bit in order]
    inverted = [{**entry, "inverse": True} for entry in plain]
    if inverses in ("pairs", "first"):
        pairs = zip(plain, inverted, strict=True) if inverses == "pairs" else zip(inverted, plain, strict=True)
        return [entry for pair in pairs for entry in pair]
    return [*plain, *inverted] if inverses == "blocks" else plain


@dataclass(frozen=True, kw_only=True)
class PhaseStack:
    """The layout of a stack of phase shifts with images (1 + cos(2πu/P + offset ∓ 2πi/N)) / 2 in period P at step i of N."""

    axes: tuple[str, ...]
    """column, row or both, in the order of the images."""
    periods_px: tuple[float, ...]
    """Periods along the columns in projector pixels, in the order of the images."""
    row_periods_px: tuple[float, ...] | None = None
    """The periods along the rows; None: the same."""
    steps: int
    order: tuple[str, ...] = LOOPS
    """The loops, of LOOPS, the one that changes slowest first."""
    advancing: bool = True
    """True if the pattern moves to larger columns from step to step (minus in the formula); else plus."""
    offset_deg: float = 0.0

    def entries(self) -> list[Entry]:
        """Return the patterns in the order of the images."""
        if sorted(self.order) != sorted(LOOPS):
            raise ManifestError(f"--order {','.join(self.order)}: give {', '.join(LOOPS)}, each once, what changes slowest first")
        rows = self.row_periods_px or self.periods_px
        if len(rows) != len(self.periods_px):
            raise ManifestError(f"--row-periods: has {len(rows)} periods, --periods {len(self.periods_px)}")
        shift = self.offset_deg * self.steps / 360
        whole = abs(shift - round(shift)) < 1e-6
        offset = {} if whole else {"offset_rad": radians(self.offset_deg)}
        choices: dict[str, Sequence[Any]] = {"axis": self.axes, "period": range(len(self.periods_px)), "step": range(self.steps)}
        found = []
        for values in product(*(choices[name] for name in self.order)):
            at = dict(zip(self.order, values, strict=True))
            period = (self.periods_px if at["axis"] == "column" else rows)[at["period"]]
            step = (at["step"] if self.advancing else -at["step"]) - (round(shift) if whole else 0)
            found.append({"code": "phase", "axis": at["axis"], "period_px": period, "step": step % self.steps, "steps": self.steps,
                          **offset})
        return found


def describe(entries: Sequence[Entry]) -> str:
    """Return what a list of patterns shows, in its order, in a few words."""
    words: list[str] = []
    for entry in entries:
        match entry["code"]:
            case "gray":
                text = f"Gray code of {entry['axis']}s, {entry['bits']} bits"
            case "phase" | "modulated":
                text = f"{'modulated ' if entry['code'] == 'modulated' else ''}phase of {entry['axis']}s, {entry['steps']} steps"
            case other:
                text = other
        if text not in words:
            words.append(text)
    return ", ".join(words)
