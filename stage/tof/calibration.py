"""The calibration of a time-of-flight camera, schema relit.tof/1 (noise, wiggling, offset, drift, pulse), and its fits."""

import json
import math
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stage.errors import CalibrationError
from stage.files import write_text
from stage.model import NotNegative, Positive, Strict, Text
from stage.records import read_record
from stage.tof.light_time import SPEED_OF_LIGHT

HARMONICS = 12
"""The highest harmonic of the wiggling that is fitted: four phases alias the third and fifth harmonic of the light to the fourth, the
seventh and ninth to the eighth, and their products to the twelfth; a third harmonic of 8 % leaves 1.5 mrad beyond."""
SWEEP_PART = 0.5
"""The part of a period that a sweep must cover: a table from less would be extrapolated over most of the period."""

LEAST_TERM = 1e-6
"""Singular values of the terms below this part of the largest are none: phases that no distance shows leave them open."""


class Harmonics(Strict):
    """The wiggling at one frequency: the error of a measured phase φ is Σ cos[h]·cos hφ + sin[h]·sin hφ over the harmonics h."""

    modulation_hz: Positive
    cos: Annotated[tuple[float, ...], Field(min_length=1)]
    """The cosine terms in radians, for h from 0; the first is a constant offset."""
    sin: Annotated[tuple[float, ...], Field(min_length=1)]
    """The sine terms in radians, as many as cosine terms; the first has no effect."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.cos) != len(self.sin):
            raise ValueError(f"cos has {len(self.cos)} terms, sin {len(self.sin)}: give as many")
        return self


class Temperature(Strict):
    """The drift of the range with temperature, linear about a reference temperature."""

    reference_c: float
    metres_per_c: float


class PulseShape(Strict):
    """Samples of the pulse as the detector records it; time 0 is that of a return from distance 0."""

    time_s: Annotated[tuple[float, ...], Field(min_length=3)]
    power: Annotated[tuple[NotNegative, ...], Field(min_length=3)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.time_s) != len(self.power):
            raise ValueError(f"time_s has {len(self.time_s)} entries, power {len(self.power)}: give as many")
        for index in range(1, len(self.time_s)):
            if not self.time_s[index] > self.time_s[index - 1]:
                raise ValueError(f"time_s is out of order: entry {index} is not after entry {index - 1}")
        return self


class TofCalibration(Strict):
    """The calibration of a time-of-flight camera. Missing noise and pulse are estimated from the capture, the rest is not corrected."""

    schema_: Literal["relit.tof/1"] = Field(alias="schema", default="relit.tof/1")
    electrons_per_unit: Positive | None = None
    """The photoelectrons of a recorded value of 1."""
    read_noise_electrons: NotNegative | None = None
    harmonics: tuple[Harmonics, ...] = ()
    scale: Positive = 1.0
    offset_m: float = 0.0
    """True range = scale · measured - offset_m - temperature drift."""
    temperature: Temperature | None = None
    sigma_m: NotNegative | None = None
    """The standard deviation of ranges near `middle_m` that the calibration leaves open and all pixels share; None: it is not known."""
    scale_sigma: NotNegative = 0.0
    """The standard deviation of `scale`, by which that of ranges grows away from `middle_m`."""
    middle_m: float = 0.0
    """The mean range of the distances from which `scale` was measured."""
    pulse_sigma_s: Positive | None = None
    """The standard deviation of a Gaussian pulse, including the jitter of the detector."""
    pulse: PulseShape | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.electrons_per_unit is None) != (self.read_noise_electrons is None):
            raise ValueError("electrons_per_unit and read_noise_electrons go together: give both or neither")
        if self.pulse is not None and self.pulse_sigma_s is not None:
            raise ValueError("pulse and pulse_sigma_s exclude each other")
        given = [harmonics.modulation_hz for harmonics in self.harmonics]
        if len(set(given)) != len(given):
            raise ValueError("harmonics: a frequency is given twice")
        return self

    def of_frequency(self, modulation_hz: float) -> Harmonics | None:
        """Return the wiggling at a frequency, which must agree to 1 part in 10⁶, or None when it is unknown."""
        return next((h for h in self.harmonics if abs(h.modulation_hz - modulation_hz) <= 1e-6 * modulation_hz), None)

    def sigma_at(self, range_m: float) -> float | None:
        """Return the standard deviation of a range that the calibration leaves open; None: it is not known."""
        return None if self.sigma_m is None else math.hypot(self.sigma_m, self.scale_sigma * (range_m - self.middle_m))

    def correct(self, range_m: np.ndarray, temperature_c: float | None = None) -> np.ndarray:
        """Return measured ranges in metres, corrected for scale, offset and drift.
        `temperature_c`: the temperature of the camera, for a calibration with drift. Raises CalibrationError if a temperature is given
        without drift in the calibration, or missing with it."""
        if (temperature_c is None) != (self.temperature is None):
            what = "no temperature drift, and a temperature was given" if self.temperature is None else "a temperature drift"
            raise CalibrationError(f"the time-of-flight calibration has {what}: give both or neither")
        drift = 0.0
        if self.temperature is not None and temperature_c is not None:
            drift = self.temperature.metres_per_c * (temperature_c - self.temperature.reference_c)
        return self.scale * range_m - self.offset_m - drift


def read_calibration(path: str | Path) -> TofCalibration:
    """Read a relit.tof/1 file."""
    return read_record(path, TofCalibration)


def write_calibration(calibration: TofCalibration, path: str | Path) -> None:
    """Write a relit.tof/1 file whole or not at all."""
    data = {"schema": calibration.schema_, **calibration.model_dump(mode="json", exclude_defaults=True, exclude={"schema_"})}
    write_text(path, json.dumps(data, indent=2) + "\n")


def fit_harmonics(phase_rad: np.ndarray, range_m: np.ndarray, modulation_hz: float) -> Harmonics:
    """Fit the wiggling at one frequency to phases that were measured at known ranges.
    `phase_rad`: [n] measured phases, radians. `range_m`: [n] true ranges along the ray, metres. Raises CalibrationError if there are too
    few readings, or they cover too little of a period.

    Source:
        Lindner, Kolb, "Lateral and depth calibration of PMD-distance sensors", ISVC 2006.
    """
    unknowns = 2 * HARMONICS + 1
    if phase_rad.shape != range_m.shape or phase_rad.ndim != 1 or len(phase_rad) < 2 * unknowns:
        raise CalibrationError(f"the sweep has {phase_rad.size} phases and {range_m.size} ranges: harmonics up to {HARMONICS} need "
                               f"{2 * unknowns} of each")
    covered = len(np.unique(np.floor(np.mod(phase_rad, 2 * np.pi) / (2 * np.pi) * 32))) / 32
    if covered < SWEEP_PART:
        raise CalibrationError(f"the sweep covers {100 * covered:.0f} % of a turn at {modulation_hz / 1e6:g} MHz: "
                               f"go over {100 * SWEEP_PART:.0f} % or more, {SPEED_OF_LIGHT / (2 * modulation_hz):.3g} m are a whole one")
    found = np.linalg.lstsq(harmonic_terms(phase_rad), phase_errors(phase_rad, range_m, modulation_hz), rcond=LEAST_TERM)[0]
    return Harmonics(modulation_hz=modulation_hz, cos=tuple(found[: HARMONICS + 1].tolist()), sin=(0.0, *found[HARMONICS + 1 :].tolist()))


def harmonic_terms(phase_rad: np.ndarray) -> np.ndarray:
    """Return the terms of the wiggling at phases [n], radians: [n, terms], those of the cosine from 0 on, those of the sine from 1 on."""
    angle = phase_rad[:, None] * np.arange(HARMONICS + 1)
    return np.concatenate([np.cos(angle), np.sin(angle[:, 1:])], axis=1)


def phase_errors(phase_rad: np.ndarray, range_m: np.ndarray, modulation_hz: float) -> np.ndarray:
    """Return by how much phases [n] differ from those of true ranges [n]: radians about the mean of all, so that an offset near half a
    period does not wrap."""
    error = phase_rad - 4 * np.pi * modulation_hz / SPEED_OF_LIGHT * range_m
    centre = np.angle(np.exp(1j * error).mean())
    return np.asarray(centre + np.angle(np.exp(1j * (error - centre))))


def fit_line(measured_m: np.ndarray, true_m: np.ndarray) -> tuple[float, float]:
    """Fit scale and offset of a `TofCalibration` to known ranges, [n] each, by least squares. Returns scale and offset_m."""
    if measured_m.shape != true_m.shape or measured_m.ndim != 1 or np.unique(true_m).size < 2 or np.ptp(measured_m) == 0:
        raise CalibrationError(f"{measured_m.size} measured and {true_m.size} true ranges give no line: "
                               "give as many, at two different ranges or more")
    scale, level = np.polyfit(measured_m, true_m, 1)
    return float(scale), float(-level)


def fit_temperature(error_m: np.ndarray, temperature_c: np.ndarray) -> tuple[Temperature, float]:
    """Fit the drift with temperature to range errors, [n] each, relative to the mean temperature.
    Returns the drift, and the error at its reference temperature in metres."""
    if error_m.shape != temperature_c.shape or np.unique(temperature_c).size < 2:
        raise CalibrationError("drift needs errors at two different temperatures or more: give one error a temperature")
    reference = float(temperature_c.mean())
    slope, level = np.polyfit(temperature_c - reference, error_m, 1)
    return Temperature(reference_c=reference, metres_per_c=float(slope)), float(level)



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
    """Read a relit.tof-sweep/1 file."""
    return read_record(path, Sweep)
