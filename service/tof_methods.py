"""Closed choices of time of flight, light enough for the command line to load at once."""

from enum import StrEnum


class TofFilter(StrEnum):
    """Filters, each asked for by name; flying pixels are taken out before anything is smoothed."""

    FLYING = "flying"
    """Takes out pixels that lie between two surfaces; changes no other."""
    BILATERAL = "bilateral"
    """Smooths the range within edges of the amplitude; fills nothing in."""


class WhichReturn(StrEnum):
    """Which of several returns is the depth."""

    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"
