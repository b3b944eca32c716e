"""A sweep, schema relit.tof-sweep/1: captures of a flat target that faces the camera at known distances."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Positive, Strict, Text
from stage.records import read_record

SCHEMA = "relit.tof-sweep/1"


class SweepDistance(Strict):
    """The capture of the target at one distance."""

    capture: Text
    """The folder of the capture, relative to the folder of the sweep; the mask of the capture is the target."""
    depth_m: Positive
    """The distance from the camera to the plane of the target along the optical axis, metres."""
    temperature_c: float | None = None


class Sweep(Strict):
    """The captures of a sweep, in any order."""

    schema_: Literal["relit.tof-sweep/1"] = Field(alias="schema")
    steps: Annotated[tuple[SweepDistance, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len({step.temperature_c is None for step in self.steps}) > 1:
            raise ValueError("steps: temperature_c is missing for some: give it for every step or for none")
        return self

    @property
    def commonest_temperature_c(self) -> float | None:
        """The temperature of most captures, at which the wiggling is measured, so that drift is not mistaken for wiggling."""
        return Counter(step.temperature_c for step in self.steps).most_common(1)[0][0]

    @property
    def has_drift(self) -> bool:
        """True when the captures have more than one temperature."""
        return len({step.temperature_c for step in self.steps}) > 1


def read_sweep(path: str | Path) -> Sweep:
    """Read a relit.tof-sweep/1 file.

    Raises:
        ManifestError: a field is wrong; the message names file and field.
        StorageError: the file cannot be read.
    """
    return read_record(path, Sweep, SCHEMA)
