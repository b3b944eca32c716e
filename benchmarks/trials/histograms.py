"""Photon histograms of a ray-cast room: few photons and many, pulses of every shape, and what nobody declared.

The forward model shares nothing with the simulator of `stage.tof` or the scenes of the tests: 3 × 3 rays a pixel, pulses sampled finely and
added to the bins ray by ray, photons drawn pulse after pulse where the detector counts the first alone. With `--data`, real histograms of a
plane at 159 distances too.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trials.continuous import LIGHT_M_S, RAYS, room
from benchmarks.trials.trial import Trial, range_trial
from service.depth.depth import depth
from service.requests.depth import DepthRequest, TofOptions

BINS, BIN_S = 80, 0.8e-9
REAL_FILE, REAL_BIN_S = "tmf8820_distance.json", 9.1e-11


@dataclass(frozen=True)
class Case:
    """One way to photograph the room."""

    name: str
    in_model: bool = True
    photons: float = 3000.0
    """Photons of a white surface that faces the camera at one metre."""
    background: float = 0.4
    """Photons in a bin, before the albedo."""
    sigma_s: float = 0.7e-9
    tail_s: float = 0.0
    """Decay time of a part of the pulse."""
    tail: float = 0.0
    onset: bool = False
    """A pulse that rises at once and falls as t²·e^-t, in place of the Gaussian."""
    declared: bool = False
    """Whether the calibration holds the pulse."""
    glass: float = 0.0
    """Photons of a pane 0.6 m in front of the camera."""
    pulses: int | None = None
    first_photon_only: bool = False
    scale: float = 1.0
    rounded: bool = False
    smoothed: bool = False
    reference: float = 0.0
    """Photons of the camera's own light, at 0.25 m in every histogram."""
    fog: float = 0.0
    """Scattering coefficient of fog, 1/m: single scattering from 0.2 m on, evenly in all directions."""
    ceiling: int | None = None
    """The largest number that the counter holds."""
    hot: float = 0.0
    """Counts that the timer adds to one bin of every pixel."""
    own_bins: float = 0.0
    """Standard deviation of the zeros of the pixels' timers, in bins."""


CASES = (
    Case("pulsed, strong light", photons=12000),
    Case("pulsed, few photons", photons=350, background=0.05),
    Case("pulsed, strong background", photons=1500, background=12),
    Case("pulsed, narrow pulse", sigma_s=0.15e-9),
    Case("pulsed, wide pulse", sigma_s=2.5e-9),
    Case("pulsed, behind a pane", glass=60),
    Case("pulsed, tail declared", tail_s=1.6e-9, tail=0.6, declared=True),
    Case("pulsed, pile-up declared", pulses=1500, first_photon_only=True, background=2),
    Case("pulsed, pile-up not declared", in_model=False, pulses=1500, background=2),
    Case("pulsed, mild pile-up not declared", in_model=False, pulses=8000, background=3),
    Case("pulsed, tail not declared", in_model=False, tail_s=1.6e-9, tail=0.6),
    Case("pulsed, skew pulse not declared", in_model=False, onset=True),
    Case("pulsed, counts times seven", in_model=False, scale=7, background=3),
    Case("pulsed, mean of 25 frames, rounded to 1/100", in_model=False, scale=0.04, rounded=True, background=3),
    Case("pulsed, smoothed over the bins", in_model=False, smoothed=True, background=3),
    Case("pulsed, the camera's own light", in_model=False, reference=4000),
    Case("pulsed, fog of 0.05 / m", in_model=False, photons=12000, fog=0.05),
    Case("pulsed, fog of 0.2 / m", in_model=False, photons=30000, fog=0.2),
    Case("pulsed, counters of 8 bits, full", in_model=False, photons=12000, ceiling=255),
    Case("pulsed, one bin of every pixel hot", in_model=False, hot=60),
    Case("pulsed, timers that each have a zero of their own", in_model=False, own_bins=1.5),
)


def pulse_of(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Return times in seconds and the light at them, which adds up to one."""
    step = BIN_S / 40
    times = np.arange(-round(8 * case.sigma_s / step), round((8 * case.sigma_s + 8 * case.tail_s) / step) + 1) * step
    if case.onset:
        from_onset = np.maximum(times + 2 * case.sigma_s, 0) / case.sigma_s  # highest at time 0
        power = from_onset**2 * np.exp(-from_onset)
    else:
        power = np.exp(-0.5 * (times / case.sigma_s) ** 2)
    power /= power.sum()
    if case.tail:
        late = np.exp(-np.arange(len(times)) * step / case.tail_s)
        power = (1 - case.tail) * power + case.tail * np.convolve(power, late / late.sum())[: len(power)]
    return times, power / power.sum()


def photographed(case: Case, seed: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Return counts [pixel, bin], the true range of each pixel (the median of its rays), and rows and columns."""
    random = np.random.default_rng(seed)
    ranges, normals, albedo = (values[:240, :300] for values in room())
    rows, cols = ranges.shape[0] // RAYS, ranges.shape[1] // RAYS
    facing = np.clip(np.abs(normals[..., 2]), 0.2, 1)  # of the room's surfaces; the rays are nearly along the axis
    strength = case.photons * albedo * facing / ranges**2 / RAYS**2 * np.exp(-2 * case.fog * ranges)
    pixel = (np.arange(rows * RAYS)[:, None] // RAYS * cols + np.arange(cols * RAYS) // RAYS).ravel()
    times, power = pulse_of(case)
    mean = np.repeat(case.background * np.bincount(pixel, albedo.ravel())[:, None] / RAYS**2, BINS, axis=1)
    ways = [(ranges, strength)]
    if case.glass:
        ways.append((np.full(ranges.shape, 0.6), np.full(ranges.shape, case.glass / RAYS**2)))
    if case.reference:
        ways.append((np.full(ranges.shape, 0.25), np.full(ranges.shape, case.reference / RAYS**2)))
    for near in np.arange(0.2, 7.0, 0.05) if case.fog else ():
        back = case.photons * case.fog / 4 / near**2 * np.exp(-2 * case.fog * near) * 0.05 / RAYS**2
        seen = np.bincount(pixel, (near < ranges).ravel() * back, rows * cols)
        bins = np.bincount(np.maximum(np.floor((2 * near / LIGHT_M_S + times) / BIN_S).astype(int), 0), power, BINS)[:BINS]
        mean += seen[:, None] * bins
    for distance, light in ways:
        for time, part in zip(times, power, strict=True):
            if part > 1e-7:
                which = np.floor((2 * distance.ravel() / LIGHT_M_S + time) / BIN_S).astype(int)
                inside = (which >= 0) & (which < BINS)
                np.add.at(mean, (pixel[inside], which[inside]), part * light.ravel()[inside])
    truth = np.median(ranges.reshape(rows, RAYS, cols, RAYS).transpose(0, 2, 1, 3).reshape(rows * cols, -1), axis=1)
    if case.pulses is None:
        counts = random.poisson(mean).astype(np.float64)
    else:
        missed = np.exp(-(np.cumsum(mean, axis=1) - mean) / case.pulses)
        first = missed * -np.expm1(-mean / case.pulses)
        counts = random.multinomial(case.pulses, np.concatenate([first, 1 - first.sum(axis=1, keepdims=True)], axis=1))[:, :-1]
    counts[:, BINS // 2] += random.poisson(case.hot, len(counts))
    if case.own_bins:
        counts = np.stack([np.roll(one, by) for one, by in zip(counts, random.normal(0, case.own_bins, len(counts)).round().astype(int),
                                                               strict=True)])
    if case.ceiling is not None:
        counts = np.minimum(counts, case.ceiling)
    if case.smoothed:
        counts = 0.5 * counts + 0.25 * np.roll(counts, 1, axis=1) + 0.25 * np.roll(counts, -1, axis=1)
    counts = counts * case.scale
    return np.round(counts, 2) if case.rounded else counts, truth, (rows, cols)


def solved(case: Case, seed: int = 30) -> Trial:
    """Photograph the room, solve it with `relit depth`, and compare ranges."""
    counts, truth, (rows, cols) = photographed(case, seed)
    light: dict[str, Any] = {"type": "pulsed", "bin_s": BIN_S, "start_s": 0.0}
    if case.first_photon_only:
        light |= {"pulses": case.pulses, "first_photon_only": True}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder, counts.reshape(rows, cols, BINS), light)
        options: dict[str, Any] = {}
        if case.declared:
            times, power = pulse_of(case)
            (folder / "camera.json").write_text(json.dumps({"schema": "relit.tof/1", "pulse": {
                "time_s": times[::4].tolist(), "power": power[::4].tolist()}}))
            options["calibration"] = folder / "camera.json"
        result = depth(DepthRequest(capture=folder, out=folder / "out", tof=TofOptions.model_validate(options), device="cpu"))
    assert result.maps.range is not None
    error = np.abs(result.maps.range.ravel() - truth)
    if case.glass:
        error = np.minimum(error, np.abs(result.maps.range.ravel() - 0.6))  # the pane is a return too
    return range_trial(case.name, case.in_model, error, result)


def _write(folder: Path, counts: np.ndarray, light: dict[str, Any]) -> None:
    """Write histograms [rows, cols, bins] as a capture."""
    rows, cols = counts.shape[:2]
    np.save(folder / "h.npy", counts.astype(np.float32))
    camera = {"projection": "perspective", "resolution": [cols, rows], "focal_px": [95.0, 95.0]}
    (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "room", "camera": camera,
                                                     "frames": [{"image": "h.npy", "tof": light}]}))


def real(path: Path) -> Trial:
    """Solve the sums of nine zones at 159 distances of a plane, and compare distances after scale and offset, as a calibration has them."""
    poses = json.loads(path.read_text())
    truth = np.array([pose["dist_to_plane"] for pose in poses])
    counts = np.array([pose["hists"] for pose in poses]).sum(axis=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder, counts[None], {"type": "pulsed", "bin_s": REAL_BIN_S, "start_s": 0.0})
        result = depth(DepthRequest(capture=folder, out=folder / "out", tof=TofOptions(vote=False), device="cpu"))
    maps = result.maps
    assert maps.range is not None and maps.sigma is not None and maps.confidence is not None
    measured = maps.range.ravel().astype(np.float64)
    scale, offset = np.polyfit(measured, truth, 1)
    along = (maps.depth / np.maximum(maps.range, 1e-9)).ravel()
    return Trial("pulsed, real plane, pulse not declared", False, 1000 * np.abs(scale * measured + offset - truth),
                 1000 * maps.sigma.ravel() / along, maps.confidence.ravel().astype(np.float64), maps.mask.ravel(), "mm",
                 " ".join(result.warnings))


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case, and the real plane where it is at hand."""
    for case in CASES:
        yield solved(case)
    if data is not None and (data / REAL_FILE).is_file():
        yield real(data / REAL_FILE)
