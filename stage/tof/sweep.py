"""A sweep over known distances: captures of a flat target that faces the camera; schema relit.tof-sweep/1."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from stage.model import Positive, Strict, Text
from stage.records import read_record

SCHEMA = "relit.tof-sweep/1"


class Step(Strict):
    """One distance."""

    capture: Text
    """Folder of the capture, from the sweep's own folder; its mask is where the target is."""
    depth_m: Positive
    """From the camera to the target's plane, along the optical axis."""
    temperature_c: float | None = None


class Sweep(Strict):
    """The steps, in any order."""

    schema_: Literal["relit.tof-sweep/1"] = Field(alias="schema")
    steps: Annotated[tuple[Step, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len({step.temperature_c is None for step in self.steps}) > 1:
            raise ValueError("steps: temperature_c is missing for some: give it for every step or for none")
        return self

    @property
    def commonest_temperature_c(self) -> float | None:
        """At which most steps were taken: wiggling is measured there, so that drift is not mistaken for it."""
        return Counter(step.temperature_c for step in self.steps).most_common(1)[0][0]

    @property
    def has_drift(self) -> bool:
        """Whether there are several temperatures."""
        return len({step.temperature_c for step in self.steps}) > 1


def read_sweep(path: str | Path) -> Sweep:
    """Read a sweep.

    Raises:
        ManifestError: a field is wrong; names file and field.
        StorageError: it cannot be read.
    """
    return read_record(path, Sweep, SCHEMA)
