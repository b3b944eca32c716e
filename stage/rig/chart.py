"""The readings of a colour chart, a JSON file with schema relit.chart/1: what a camera sees of each patch under each primary of a rig, and
under the light that is to be reproduced.

The readings are given, or they follow from spectra: of the patches, the camera's channels and the light, and of the rig's primaries.
"""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from stage.errors import ManifestError
from stage.model import FirstFault, NotNegative, Positive, Rgb, Strict, Text
from stage.records import read_record
from stage.rig.rig import Lamp

CHART_SCHEMA = "relit.chart/1"
Samples = Annotated[tuple[NotNegative, ...], Field(min_length=2), FirstFault]


class ChartSpectra(Strict):
    """Spectra from which the readings of a chart follow, all at the same wavelengths."""

    wavelength_nm: Annotated[tuple[Positive, ...], Field(min_length=2), FirstFault]
    """The wavelengths, evenly spaced and rising."""
    reflectance: Annotated[tuple[Samples, ...], Field(min_length=1), FirstFault]
    """The reflectance of each patch."""
    sensitivity: tuple[Samples, Samples, Samples]
    """The sensitivity of the red, green and blue channel of the camera."""
    illuminant: Samples
    """The spectrum of the light that is to be reproduced where the environment is white, at an irradiance of 1 in each channel."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        count = len(self.wavelength_nm)
        for name, rows in (("reflectance", self.reflectance), ("sensitivity", self.sensitivity), ("illuminant", (self.illuminant,))):
            if any(len(row) != count for row in rows):
                raise ValueError(f"{name}: has other than {count} samples, as wavelength_nm has")
        steps = np.diff(self.wavelength_nm)
        if steps.min() <= 0 or np.ptp(steps) > 1e-6 * steps.max():
            raise ValueError("wavelength_nm must rise in even steps")
        return self


class Chart(Strict):
    """The content of a chart file: `target` and `primaries`, or `spectra`."""

    schema_: Literal["relit.chart/1"] = Field(alias="schema")
    """The kind and version of the file."""
    target: Annotated[tuple[Rgb, ...], FirstFault] | None = None
    """The readings of the patches under white light of the environment, at an irradiance of 1 in each channel."""
    primaries: dict[Text, Annotated[tuple[Rgb, ...], FirstFault]] | None = None
    """The readings of the patches under each primary at full level, by its name."""
    irradiance: dict[Text, Rgb] | None = None
    """The irradiance of each primary under which it was read; None: that of every lamp at full level."""
    spectra: ChartSpectra | None = None
    """The spectra; None: readings are given."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.spectra is None) == (self.target is None or not self.primaries):
            raise ValueError("give target and primaries, or spectra alone")
        for name, readings in (self.primaries or {}).items():
            if len(readings) != len(self.target or ()):
                raise ValueError(f"primaries.{name}: has {len(readings)} patches, target has {len(self.target or ())}")
        if self.irradiance is not None:
            if self.spectra is not None or set(self.irradiance) != set(self.primaries or {}):
                raise ValueError("irradiance: must name each of primaries, and no other")
            if dark := [name for name, value in self.irradiance.items() if not max(value) > 0]:
                raise ValueError(f"irradiance.{dark[0]}: must be above 0 in one channel")
        return self


class ChartReadings(NamedTuple):
    """The readings of a chart for the lamps of a rig."""

    path: Path
    chart: Chart

    @property
    def target(self) -> np.ndarray:
        """Return [patches, 3] the readings under white light."""
        spectra = self.chart.spectra
        return np.array(self.chart.target) if spectra is None else _readings(spectra, np.array(spectra.illuminant))

    def of(self, lamp: Lamp) -> np.ndarray:
        """Return [primaries, patches, 3] the readings under each primary of a lamp at full level.
        Raises ManifestError if the file has no readings for a primary, or the rig no spectrum of it."""
        spectra = self.chart.spectra
        if spectra is None:
            missing = [primary.name for primary in lamp.primaries if primary.name not in (self.chart.primaries or {})]
            if missing:
                raise ManifestError(f"{self.path}: primaries: has no readings under {missing[0]}, which the lamp {lamp.name} has")
            readings = np.array([(self.chart.primaries or {})[primary.name] for primary in lamp.primaries])
            if self.chart.irradiance is None:
                return readings
            power = [sum(primary.irradiance) / sum(self.chart.irradiance[primary.name]) for primary in lamp.primaries]
            return readings * np.array(power)[:, None, None]
        for primary in lamp.primaries:
            if primary.spectrum is None:
                raise ManifestError(f"{self.path}: spectra: the primary {primary.name} of the lamp {lamp.name} has no spectrum in the rig")
        return np.stack([_readings(spectra, np.interp(spectra.wavelength_nm, primary.spectrum.wavelength_nm, primary.spectrum.power, 0, 0))
                         for primary in lamp.primaries if primary.spectrum is not None])


def read_chart(path: Path) -> ChartReadings:
    """Read and check the file of a chart."""
    return ChartReadings(path, read_record(path, Chart))


def _readings(spectra: ChartSpectra, light: np.ndarray) -> np.ndarray:
    """Return [patches, 3] what the camera sees of the patches under a spectrum."""
    step = spectra.wavelength_nm[1] - spectra.wavelength_nm[0]
    return np.einsum("jw,kw,w->jk", np.array(spectra.reflectance), np.array(spectra.sensitivity), light) * step
