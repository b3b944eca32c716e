"""The file of the regions of a design with their tolerances, schema relit.tolerances/1."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Direction, Finite, FirstFault, Strict, Text, Vector
from stage.records import faults_of_each, read_record


class ToleranceRegion(Strict):
    """A part of the surface of a design: what lies in a box, and what faces a direction, or both."""

    name: Text
    """The name of the region, unlike the others."""
    box: tuple[Vector, Vector] | None = None
    """The corners of a box with the smallest and the largest coordinates, in the unit of the file; None: all of the surface."""
    facing: Direction | None = None
    """The direction that the surface faces; None: any."""
    within_deg: Annotated[float, Field(gt=0, le=180)] = 30.0
    """The largest angle between the surface's normal and `facing`, degrees."""
    tolerance: tuple[Finite, Finite]
    """The smallest and the largest deviation that is allowed, in the unit of the file; outside of the design is positive."""
    datum: bool = False
    """Whether the scan is laid on the design by this region, and others like it, alone."""

    @property
    def is_whole(self) -> bool:
        """Whether it is all of the surface."""
        return self.box is None and self.facing is None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.tolerance[0] >= self.tolerance[1]:
            raise ValueError(f"tolerance: is {list(self.tolerance)}: give the smaller limit first")
        if self.box is not None and any(low >= high for low, high in zip(*self.box, strict=True)):
            raise ValueError("box: give the corner with the smallest coordinates first")
        return self


class Tolerances(Strict):
    """The regions of a design."""

    schema_: Literal["relit.tolerances/1"] = Field(alias="schema")
    """The kind and version of the file."""
    unit: Literal["m", "cm", "mm", "um", "in"]
    """The unit of boxes and tolerances."""
    regions: Annotated[tuple[ToleranceRegion, ...], Field(min_length=1), FirstFault]
    """The regions; they may overlap."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [region.name for region in self.regions]
        if len(set(names)) < len(names):
            raise ValueError(f"regions: {next(name for name in names if names.count(name) > 1)} is there twice: each has its own name")
        return self


def read_tolerances(path: Path) -> Tolerances:
    """Read a file of regions. Raises ManifestError if it is wrong; names file and field. Raises StorageError if it cannot be read."""
    return read_record(path, Tolerances, lambda data: faults_of_each(data, "regions", ToleranceRegion))
