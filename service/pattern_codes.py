"""The closed choices of `relit patterns`; apart, so that the command line starts without pydantic."""

from enum import StrEnum


class PatternCode(StrEnum):
    """What to project."""

    BINARY = "binary"
    """Binary numbers of stripes."""
    GRAY = "gray"
    """Gray code: one image changes at an edge."""
    XOR = "xor"
    """Gray code in narrow stripes, for surfaces that light each other."""
    KARY = "kary"
    """Base-k digits as grey levels."""
    COLOR = "color"
    """Base-k digits as colours."""
    RAMP = "ramp"
    """Intensity ratio."""
    PHASE = "phase"
    """Phase shifting."""
    GRAY_PHASE = "gray-phase"
    """Phase shifting of one period, numbered by Gray code."""
    MICRO = "micro"
    """Micro phase shifting."""
    MODULATED = "modulated"
    """Modulated phase shifting."""


class PatternAxis(StrEnum):
    """Which projector coordinate is coded."""

    COLUMN = "column"
    ROW = "row"
    BOTH = "both"
