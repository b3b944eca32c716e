"""Continuous-wave time of flight on a ray-cast room of curved walls and balls, with mixed edges, little light, and what nobody declared.

The forward model shares nothing with the simulator of `stage.tof` or the scenes of the tests: 3 × 3 rays a pixel, the path from the source
to the surface to the sensor, second returns from a facing wall, and a wave that is not a cosine.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trials.trial import Trial, range_trial
from service.depth.depth import depth
from service.requests.depth import DepthRequest

ROWS, COLS, RAYS, FOCAL_PX = 90, 120, 3, 95.0
LIGHT_M_S = 299_792_458.0
FOG_STEP_M = 0.1


@dataclass(frozen=True)
class Case:
    """One way to photograph the room."""

    name: str
    in_model: bool = True
    hz: tuple[float, ...] = (16e6, 60e6, 100e6)
    phases: int = 4
    electrons: float = 3e5
    """Electrons of a white surface that faces the source at one metre."""
    ambient: float = 30.0
    source: tuple[float, float, float] = (0.0, 0.0, 0.0)
    declared: bool = True
    third: float = 0.0
    """Third harmonic of the light, relative to the first."""
    bounced: float = 0.0
    """Light by way of a wall 1.1 m aside, relative to the direct light, near the floor."""
    fog: float = 0.0
    """Scattering coefficient of a fog that begins 0.3 m before the camera, 1/m."""
    misread: Callable[[dict[str, Any]], dict[str, Any]] = dict
    """What is declared in place of the entry of a frame."""


CASES = (
    Case("cw, strong light"),
    Case("cw, two frequencies, a fifth", hz=(40e6, 70e6), electrons=6e4),
    Case("cw, three phases, weak light", hz=(20e6, 50e6, 120e6), phases=3, electrons=8e3, ambient=50.0),
    Case("cw, source 6 cm aside", source=(0.06, 0.02, 0.0)),
    Case("cw, source aside, not declared", in_model=False, source=(0.06, 0.02, 0.0), declared=False),
    Case("cw, wiggling not calibrated", in_model=False, third=0.06),
    Case("cw, light bounced near the floor", in_model=False, bounced=0.25),
    Case("cw, phases declared backwards", in_model=False, misread=lambda entry: entry | {
        "reference_phase_rad": -entry["reference_phase_rad"] % (2 * np.pi)}),
    Case("cw, 60 MHz declared as 62", in_model=False, misread=lambda entry: entry | {
        "modulation_hz": {60e6: 62e6}.get(entry["modulation_hz"], entry["modulation_hz"])}),
    Case("cw, two frequencies exchanged", in_model=False, hz=(40e6, 70e6), misread=lambda entry: entry | {
        "modulation_hz": 110e6 - entry["modulation_hz"]}),
    Case("cw, fog of 0.05 / m", in_model=False, fog=0.05),
    Case("cw, 30 MHz alone, which tell 5 m apart", in_model=False, hz=(30e6,)),
)


def room() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ranges, unit normals and albedo at each ray, [rows·3, cols·3, …]."""
    v, u = (np.mgrid[0:ROWS * RAYS, 0:COLS * RAYS] + 0.5) / RAYS
    ray = np.stack([(u - COLS / 2) / FOCAL_PX, (ROWS / 2 - v) / FOCAL_PX, -np.ones_like(u)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    # inside of a cylinder of radius 2.2 m about the line of sight, a back wall, a floor, three balls
    sine = np.sqrt(1 - ray[..., 2] ** 2)
    found, normal = 2.2 / sine, np.stack([-ray[..., 0] / sine, -ray[..., 1] / sine, np.zeros_like(sine)], axis=-1)
    for middle, facing in (((0, 0, -5.5), (0.1, 0, 1)), ((0, -1.0, 0), (0, 1, 0))):
        n = np.array(facing, float) / np.linalg.norm(facing)
        with np.errstate(divide="ignore", invalid="ignore"):
            there = np.array(middle, float) @ n / (ray @ n)
        nearer = (there > 0) & (there < found)
        found, normal = np.where(nearer, there, found), np.where(nearer[..., None], n, normal)
    for centre, radius in (((-0.5, -0.6, -2.2), 0.4), ((0.8, 0.3, -3.4), 0.5), ((0.15, 0.2, -1.3), 0.12)):
        middle = ray @ np.array(centre)
        square = middle**2 - (np.dot(centre, centre) - radius**2)
        there = middle - np.sqrt(np.maximum(square, 0))
        nearer = (square > 0) & (there < found)
        out = (there[..., None] * ray - np.array(centre)) / radius
        found, normal = np.where(nearer, there, found), np.where(nearer[..., None], out, normal)
    points = found[..., None] * ray
    stripes = 0.5 + 0.5 * np.sign(np.sin(7 * points[..., 0] + 3 * points[..., 2]) * np.sin(6 * points[..., 1] + 1))
    return found, normal, 0.15 + 0.65 * stripes


def photographed(case: Case, seed: int) -> tuple[np.ndarray, list[dict[str, object]], np.ndarray]:
    """Return images [n, rows, cols], their `tof` entries, and the true range of each pixel (the median of its rays)."""
    random = np.random.default_rng(seed)
    range_m, normal, albedo = room()
    v, u = (np.mgrid[0:ROWS * RAYS, 0:COLS * RAYS] + 0.5) / RAYS
    ray = np.stack([(u - COLS / 2) / FOCAL_PX, (ROWS / 2 - v) / FOCAL_PX, -np.ones_like(u)], axis=-1)
    points = range_m[..., None] * ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    to_source = np.array(case.source) - points
    leg = np.linalg.norm(to_source, axis=-1)
    strength = case.electrons * albedo * np.maximum((to_source * normal).sum(axis=-1) / leg, 0) / leg**2
    ways = [(range_m + leg, strength)]
    if case.bounced:
        height = points[..., 1] + 1.0
        ways.append((range_m + leg + 1.1, case.bounced * strength * np.exp(-height / 0.3)))
    if case.fog:
        ways = [(path, light * np.exp(-case.fog * path)) for path, light in ways]
        for at in np.arange(0.3, 6.0, FOG_STEP_M):
            scattered = case.electrons * case.fog / 4 * np.exp(-2 * case.fog * at) / at**2 * FOG_STEP_M
            ways.append((np.full_like(leg, 2 * at), scattered * (at < range_m)))
    images, entries = [], []
    for hz in case.hz:
        for step in range(case.phases):
            delta = 2 * np.pi * step / case.phases
            mean = case.ambient * albedo
            for path, light in ways:
                turn = 2 * np.pi * hz * path / LIGHT_M_S - delta
                mean = mean + light * (1 + np.cos(turn) + case.third * np.cos(3 * turn))
            pixel = np.maximum(mean, 0).reshape(ROWS, RAYS, COLS, RAYS).mean(axis=(1, 3))
            images.append(random.poisson(pixel) + random.normal(0, 6, pixel.shape))
            entries.append(case.misread({"type": "cw", "modulation_hz": hz, "reference_phase_rad": delta,
                                         **({"source_m": case.source} if case.declared and any(case.source) else {})}))
    truth = np.median(range_m.reshape(ROWS, RAYS, COLS, RAYS).transpose(0, 2, 1, 3).reshape(ROWS, COLS, -1), axis=-1)
    return np.array(images), entries, truth


def solved(case: Case, seed: int = 20) -> Trial:
    """Photograph the room, solve it with `relit depth`, and compare ranges."""
    images, entries, truth = photographed(case, seed)
    with tempfile.TemporaryDirectory() as name:
        folder, frames = Path(name), []
        for index, (image, entry) in enumerate(zip(images, entries, strict=True)):
            np.save(folder / f"{index:02d}.npy", image.astype(np.float32))
            frames.append({"image": f"{index:02d}.npy", "tof": entry})
        camera = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [FOCAL_PX, FOCAL_PX]}
        (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "room", "camera": camera, "frames": frames}))
        result = depth(DepthRequest(capture=folder, out=folder / "out", device="cpu"))
    assert result.maps.range is not None
    return range_trial(case.name, case.in_model, np.abs(result.maps.range - truth).ravel(), result)


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case."""
    for case in CASES:
        yield solved(case)
