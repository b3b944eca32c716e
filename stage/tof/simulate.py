"""Simulation of raw time-of-flight frames, for tests and for the planning of captures.

Forward model, at each pixel with range r, distance e from the source, half path d = (r + e)/2, albedo ρ and cos θ between the surface
normal and the direction to the source; a source at the camera has r = e = d:

    signal       A = signal_electrons · ρ · cos θ / e²                         electrons (photons) of one return
    correlation  I(δ) = ambient · ρ + Σ_returns A·(1 + contrast · w(φ - δ)),   φ = 4πf·d/c
                 w(ψ) = cos ψ + Σ_h harmonics[h]·cos(hψ), h from 2              wiggling: the light is not a pure cosine
    histogram    λ_i = background + Σ_returns A·(C(t_{i+1} - τ) - C(t_i - τ)),  τ = 2d/c, C the cumulative Gaussian of pulse_sigma_s
    pile-up      of `pulses`, m_i have counted no photon before bin i; bin i counts binomial(m_i, 1 - exp(-λ_i / pulses))

A second return lies `second_m` behind the first with `second_part` of its signal: light that was reflected twice, or a pane of glass.
Shot noise is Poisson, read noise is normal, and counts are clipped to `full_well`. Without a random generator the means are returned.

Source: Lange and Seitz, "Solid-state time-of-flight range camera", IEEE J. Quantum Electronics 37(3), 2001; pile-up: Coates, "The
    correction for photon pile-up in the measurement of radiative lifetimes", J. Physics E 1(8), 1968.
"""

from dataclasses import dataclass, replace
from math import erf
from pathlib import Path

import numpy as np

from stage.capture.camera import Camera
from stage.capture.light import ContinuousWave, Pulsed
from stage.capture.manifest import FILE_NAME, SCHEMA, Frame, Manifest, write_manifest
from stage.errors import CalibrationError
from stage.files import replacing
from stage.model import Vector
from stage.tof.light_time import SPEED_OF_LIGHT


@dataclass(frozen=True, kw_only=True)
class TofScene:
    """The scene in front of the camera: range, albedo and the angle of the surface at each pixel."""

    range_m: np.ndarray  # [rows, cols] metres along the ray, above zero
    albedo: np.ndarray  # [rows, cols] 0…1
    cosine: np.ndarray  # [rows, cols] 0…1, between normal and direction to the source
    source_range_m: np.ndarray | None = None
    """[rows, cols] metres from the light source to the surface, above zero; None: the source is at the camera."""
    second_m: float = 1.0
    second_part: float = 0.0
    """The signal of the second return relative to the first; 0 means one return."""

    def __post_init__(self) -> None:
        """Raise CalibrationError for arrays of different shapes, ranges that are not above zero, and an impossible second return."""
        if not self.range_m.shape == self.albedo.shape == self.cosine.shape or self.range_m.ndim != 2:
            raise CalibrationError(f"range {self.range_m.shape}, albedo {self.albedo.shape} and cosine {self.cosine.shape} "
                                   "must be one image: give [rows, cols] each")
        if not (np.isfinite(self.range_m).all() and self.range_m.min() > 0):
            raise CalibrationError("the scene has ranges that are not above zero")
        if self.source_range_m is not None and not (self.source_range_m.shape == self.range_m.shape and self.source_range_m.min() > 0):
            raise CalibrationError(f"the distances from the source are {self.source_range_m.shape}, or not above zero: "
                                   f"give {self.range_m.shape}")
        if self.second_part < 0 or self.second_m <= 0:
            raise CalibrationError("the second return must lie behind the first, with no negative part of its signal")

    def returns(self, signal: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the half path and the signal of each return, [rows, cols] each, for the signal of a white surface at one metre."""
        source_range = self.range_m if self.source_range_m is None else self.source_range_m
        first = signal * self.albedo * self.cosine / source_range**2
        half_path = 0.5 * (self.range_m + source_range)
        both = [(half_path, first), (half_path + self.second_m, self.second_part * first)]
        return both if self.second_part > 0 else both[:1]


@dataclass(frozen=True, kw_only=True)
class CorrelationCamera:
    """A continuous-wave camera, which records correlation images."""

    modulation_hz: tuple[float, ...] = (20e6, 30e6, 80e6)
    phases: int = 4
    """The count of evenly spaced reference phases of each frequency."""
    signal_electrons: float = 1e5
    """The electrons in one image of a white surface that faces the camera at one metre."""
    contrast: float = 1.0
    ambient_electrons: float = 0.0
    """The electrons of ambient light in one image of a white surface."""
    read_noise_electrons: float = 5.0
    harmonics: tuple[float, ...] = ()
    """The harmonics of the correlation function from the second on, relative to the first."""
    full_well: float | None = None

    def settings(self) -> list[tuple[float, float]]:
        """Return the frequency in hertz and the reference phase in radians of each image."""
        return [(hz, 2 * np.pi * step / self.phases) for hz in self.modulation_hz for step in range(self.phases)]


@dataclass(frozen=True, kw_only=True)
class HistogramCamera:
    """A pulsed camera, which counts photons in a histogram for each pixel."""

    bins: int = 64
    bin_s: float = 1.5e-9
    start_s: float = 0.0
    pulse_sigma_s: float = 1.2e-9
    signal_photons: float = 4000.0
    """The photons of all pulses together from a white surface that faces the camera at one metre."""
    background: float = 0.5
    """The background photons in a bin, of all pulses together."""
    pulses: int | None = None
    """The count of pulses of a detector that counts only the first photon after each pulse; None for one that counts all photons."""


def correlation_images(scene: TofScene, camera: CorrelationCamera, random: np.random.Generator | None = None) -> np.ndarray:
    """Return correlation images, with noise when `random` is given: [images, rows, cols] float64 electrons, in the order of
    `camera.settings()`."""
    images = []
    for hz, delta in camera.settings():
        mean = camera.ambient_electrons * scene.albedo
        for range_m, signal in scene.returns(camera.signal_electrons):
            angle = 4 * np.pi * hz / SPEED_OF_LIGHT * range_m - delta
            wave = np.cos(angle) + sum(part * np.cos((index + 2) * angle) for index, part in enumerate(camera.harmonics))
            mean = mean + signal * (1 + camera.contrast * wave)
        mean = np.maximum(mean, 0)
        recorded = mean
        if random is not None:
            recorded = random.poisson(mean) + random.normal(0.0, camera.read_noise_electrons, mean.shape)
        images.append(recorded if camera.full_well is None else np.minimum(recorded, camera.full_well))
    return np.stack(images)


def histograms(scene: TofScene, camera: HistogramCamera, random: np.random.Generator | None = None) -> np.ndarray:
    """Return photon histograms [rows, cols, bins] float64, with noise when `random` is given."""
    edges = camera.start_s + camera.bin_s * np.arange(camera.bins + 1)
    mean = np.full((*scene.range_m.shape, camera.bins), camera.background, dtype=np.float64)
    cumulative = np.vectorize(erf, otypes=[np.float64])
    for range_m, signal in scene.returns(camera.signal_photons):
        delay = 2 * range_m[..., None] / SPEED_OF_LIGHT
        mean += signal[..., None] * np.diff(0.5 * cumulative((edges - delay) / (camera.pulse_sigma_s * 2**0.5)), axis=-1)
    if camera.pulses is None:
        return mean if random is None else random.poisson(mean).astype(np.float64)
    seen = -np.expm1(-mean / camera.pulses)
    counts = np.empty_like(mean)
    left = np.full(scene.range_m.shape, float(camera.pulses))
    for index in range(camera.bins):
        counts[..., index] = left * seen[..., index] if random is None else random.binomial(left.astype(np.int64), seen[..., index])
        left = left - counts[..., index]
    return counts


def write_correlations(folder: str | Path, name: str, images: np.ndarray, camera: Camera, sensor: CorrelationCamera,
                       source_m: Vector | None = None) -> Path:
    """Write images of `correlation_images` as a capture, with the place of the light source in the camera frame (None: at the camera)."""
    frames = []
    for index, (image, (hz, delta)) in enumerate(zip(images, sensor.settings(), strict=True)):
        frames.append(Frame(image=f"{index:03d}.npy", tof=ContinuousWave(type="cw", modulation_hz=hz, reference_phase_rad=delta,
                                                                          source_m=source_m)))
        _save(Path(folder) / frames[-1].image, image)
    return _manifest(folder, name, camera, frames, sensor.full_well)


def write_histograms(folder: str | Path, name: str, counts: np.ndarray, camera: Camera, sensor: HistogramCamera,
                     source_m: Vector | None = None) -> Path:
    """Write counts of `histograms` as a capture, with the place of the light source in the camera frame (None: at the camera)."""
    _save(Path(folder) / "histograms.npy", counts)
    tof = Pulsed(type="pulsed", bin_s=sensor.bin_s, start_s=sensor.start_s, pulses=sensor.pulses,
                 first_photon_only=sensor.pulses is not None, source_m=source_m)
    return _manifest(folder, name, camera, [Frame(image="histograms.npy", tof=tof)], None)


def _save(path: Path, values: np.ndarray) -> None:
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.save(stream, values.astype(np.float32))


def _manifest(folder: str | Path, name: str, camera: Camera, frames: list[Frame], saturation: float | None) -> Path:
    path = Path(folder) / FILE_NAME
    write_manifest(Manifest.model_validate({"schema": SCHEMA, "name": name, "camera": camera, "saturation": saturation,
                                            "frames": tuple(frames)}), path)
    return path


MEDIAN_PER_SIGMA = 0.674490
"""The median of the absolute error over its standard deviation, for a normal error."""


def range_bound_m(scene: TofScene, camera: HistogramCamera) -> np.ndarray:
    """Return the least standard deviation that an unbiased estimate of the range of each pixel can have.

    With λ the mean of each bin, t the time of the return and s its photons, σ² ≥ 1/(F_tt - F_ts²/F_ss), F_xy = Σ λ_x·λ_y·w over the bins;
    w is 1/λ for Poisson counts. Without background and with fine bins that is σ ≥ (c/2)·pulse_sigma_s/√s. When each of N pulses
    counts one photon at most, a is the part of the pulses without an earlier photon, and w is a/(N·(e^(λ/N) - 1)).
    `scene`: range, albedo and cosine; the bound is that of the first return, when the second return is known, and that of half the path of
    light where the source is not at the camera. `camera`: bins, pulse, photons, background (which is known) and pulses. Returns [rows,
    cols] float64 metres; infinite where the histogram contains no light of the return.

    Source:
        Bar-David, "Communication under the Poisson regime", IEEE Trans. Information Theory 15(1), 1969; Kay, "Fundamentals of
        Statistical Signal Processing: Estimation Theory", 1993, section 3.7 (an unknown that is not asked for).
    """
    mean = histograms(scene, replace(camera, pulses=None))
    edges = camera.start_s + camera.bin_s * np.arange(camera.bins + 1)
    half_path, signal = scene.returns(camera.signal_photons)[0]
    away = (edges - 2 * half_path[..., None] / SPEED_OF_LIGHT) / camera.pulse_sigma_s
    by_time = -signal[..., None] * np.diff(np.exp(-0.5 * away**2), axis=-1) / (camera.pulse_sigma_s * (2 * np.pi) ** 0.5)
    only = histograms(replace(scene, second_part=0.0), replace(camera, pulses=None, background=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        if camera.pulses is None:
            weight = 1 / mean
        else:
            live = np.exp(-(np.cumsum(mean, axis=-1) - mean) / camera.pulses)
            weight = live / (camera.pulses * np.expm1(mean / camera.pulses))
        weight = np.where(mean > 0, weight, 0)
        tt, ts, ss = ((a * b * weight).sum(axis=-1) for a, b in ((by_time, by_time), (by_time, only), (only, only)))
        sigma_s = 1 / np.sqrt(np.maximum(tt - np.where(ss > 0, ts**2 / ss, 0), 0))
    return 0.5 * SPEED_OF_LIGHT * sigma_s
