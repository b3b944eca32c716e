"""A moving subject with a known truth: a textured Lambertian cap that glides and turns in the image plane, rendered in float64 at
any time, and captures of it with tracking frames. Nothing here leans on the code that it judges."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.scenes.captures import distant, ring, write_lit

WAVES = 60
RADIUS = 0.38
"""Of the cap, in image widths."""
SLOPE = 0.7
"""Sine of the cap's steepest normal."""


class Subject(NamedTuple):
    """A cap on a black ground, in the middle of the image at time 0."""

    size: int = 96
    shift_px: tuple[float, float] = (0.0, 0.0)
    """A step of time, right and down."""
    turn_degrees: float = 0.0
    """A step of time, about the middle of the cap."""
    contrast: float = 0.18

    def body(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Of every pixel, where on the subject it looks: x right and y down from the middle of the cap."""
        at = np.arange(self.size) + 0.5 - self.size / 2
        x, y = np.meshgrid(at - self.shift_px[0] * time, at - self.shift_px[1] * time)
        turn = np.radians(self.turn_degrees * time)
        return np.cos(turn) * x + np.sin(turn) * y, -np.sin(turn) * x + np.cos(turn) * y

    def mask(self, time: float) -> np.ndarray:
        """[rows, cols] bool."""
        return np.hypot(*self.body(time)) < RADIUS * self.size

    def albedo(self, time: float) -> np.ndarray:
        """[rows, cols] of the pixels' points; waves of 8 to 40 pixels."""
        rng = np.random.default_rng(5)
        frequency, way, phase = rng.uniform(1 / 40, 1 / 8, WAVES), *rng.uniform(0, 2 * np.pi, (2, WAVES))
        x, y = self.body(time)
        waves = sum(np.cos(2 * np.pi * f * (np.cos(w) * x + np.sin(w) * y) + p)
                    for f, w, p in zip(frequency, way, phase, strict=True))
        return np.clip(0.5 + self.contrast * waves / np.sqrt(WAVES / 2), 0.05, 1)

    def normal(self, time: float) -> np.ndarray:
        """[rows, cols, 3] unit, camera frame (y up): it turns with the subject."""
        at = np.arange(self.size) + 0.5 - self.size / 2
        x, y = np.meshgrid(at - self.shift_px[0] * time, at - self.shift_px[1] * time)  # a cap looks the same however it turns
        nx, ny = (np.where(self.mask(time), SLOPE * part / (RADIUS * self.size), 0) for part in (x, -y))
        return np.stack([nx, ny, np.sqrt(1 - nx**2 - ny**2)], axis=-1)

    def lit(self, time: float, direction: np.ndarray) -> np.ndarray:
        """[rows, cols, 3] radiance under a light of irradiance π."""
        image = self.albedo(time) * np.maximum(self.normal(time) @ direction, 0) * self.mask(time)
        return np.repeat(image[..., None], 3, axis=-1)

    def full(self, time: float) -> np.ndarray:
        """[rows, cols, 3] radiance under every light: a sphere, of which the grazing half is weaker."""
        image = self.albedo(time) * (0.6 + 0.4 * self.normal(time)[..., 2]) * self.mask(time)
        return np.repeat(image[..., None], 3, axis=-1)

    def flow(self, start: float, stop: float) -> np.ndarray:
        """[rows, cols, 2] displacement from time start to time stop of every point, seen at start."""
        x, y = self.body(start)
        turn = np.radians(self.turn_degrees * stop)
        at = np.arange(self.size) + 0.5 - self.size / 2
        u = np.cos(turn) * x - np.sin(turn) * y + self.shift_px[0] * stop - at
        v = np.sin(turn) * x + np.cos(turn) * y + self.shift_px[1] * stop - at[:, None]
        return np.stack([u, v], axis=-1)


def write_moving(folder: Path, subject: Subject, order: str = "TLLLLTLLLLT", **changes: Any) -> Path:
    """Write a capture: T a tracking frame, L the next light of a ring; the mask is of the middle tracking frame.

    Returns:
        The folder.
    """
    tracking = [time for time, kind in enumerate(order) if kind == "T"]
    middle = tracking[len(tracking) // 2] if tracking else 0
    directions = iter(ring(order.count("L")))
    images, lights = [], []
    for time, kind in enumerate(order):
        direction = None if kind == "T" else next(directions)
        images.append(subject.full(time - middle) if direction is None else subject.lit(time - middle, direction))
        lights.append({"type": "full"} if direction is None else distant(direction, np.pi))
    camera = {"projection": "orthographic", "resolution": [subject.size, subject.size]}
    return write_lit(folder, images, lights, names="{:02d}.exr", **{
        "name": "dancer", "mask": subject.mask(0), "camera": camera, **changes})
