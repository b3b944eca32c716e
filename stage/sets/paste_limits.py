"""The file of the limits of solder paste on pads, schema relit.paste-limits/1."""

from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.errors import ManifestError
from stage.model import Finite, FirstFault, Positive, Strict, Text
from stage.records import read_record

Range = tuple[Finite, Finite]
"""The smallest and the largest value, per cent."""
RANGES = ("volume_percent", "height_percent", "area_percent")


class PadLimits(Strict):
    """The limits of the pads whose names fit a pattern."""

    pads: Text = "*"
    """Names of pads; * stands for any characters, ? for one."""
    volume_percent: Range | None = None
    """Volume, per cent of the opening's area times the thickness of the stencil."""
    height_percent: Range | None = None
    """Mean height, per cent of the thickness of the stencil."""
    area_percent: Range | None = None
    """Area, per cent of the opening's."""
    offset_percent: Positive | None = None
    """Offset along either side of the pad, per cent of that side."""
    bridge: Literal["fail", "allow"] = "fail"
    """What paste means that connects the pad to another which says the same."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in RANGES:
            limits = getattr(self, name)
            if limits is not None and limits[0] >= limits[1]:
                raise ValueError(f"{name}: is {list(limits)}: give the smaller limit first")
        return self

    def ranges(self) -> dict[str, Range]:
        """Return the smallest and the largest value of each quantity that is limited."""
        found = {name: limits for name in RANGES if (limits := getattr(self, name)) is not None}
        if self.offset_percent is not None:
            found |= {f"offset_{axis}_percent": (-self.offset_percent, self.offset_percent) for axis in "xy"}
        return found


class LimitClass(Strict):
    """A class of boards."""

    name: Text
    limits: Annotated[tuple[PadLimits, ...], Field(min_length=1), FirstFault]
    """The first whose pattern fits a pad counts for it."""


class PasteLimits(Strict):
    """Classes of limits, of which an inspection takes one."""

    schema_: Literal["relit.paste-limits/1"] = Field(alias="schema")
    classes: Annotated[tuple[LimitClass, ...], Field(min_length=1), FirstFault]


def read_limits(path: Path, name: str | None) -> tuple[PadLimits, ...]:
    """Read the limits of a class; `name` may be None where the file has a single one. Raises ManifestError; names file and field."""
    classes = read_record(path, PasteLimits).classes
    known = ", ".join(each.name for each in classes)
    if name is None and len(classes) > 1:
        raise ManifestError(f"{path}: has the classes {known}: name one of them with --limit-class")
    found = next((each for each in classes if name in (None, each.name)), None)
    if found is None:
        raise ManifestError(f"{path}: has no class {name}: give --limit-class as one of {known}")
    return found.limits


def limits_of(pad: str, limits: tuple[PadLimits, ...]) -> PadLimits | None:
    """Return the limits of a pad by its name; None where no pattern fits."""
    return next((each for each in limits if fnmatchcase(pad, each.pads)), None)
