"""Sequences with a known truth: a bumpy dome at rest with a smaller dome that moves across a part of the image, under distant lights with
noise of its own in every step; and a sphere that moves before a plane, under projected phases."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.reference.sampling import lattice
from tests.scenes.captures import distant, write_exr, write_lit

SIZE = 64
LIGHTS = 12
PIXEL_M = 0.001
PEDESTAL = 0.05
"""What the camera adds to every value and the dark image holds, so that noise below zero is kept."""


class Moment(NamedTuple):
    """One time step."""

    normal: np.ndarray  # [rows, cols, 3]
    height: np.ndarray  # [rows, cols] metres, up to a constant
    albedo: np.ndarray  # [rows, cols, 3]
    moving: np.ndarray  # [rows, cols] bool: the small dome, wherever it is


def moment(place: float | None, *, other: bool = False, size: int = SIZE) -> Moment:
    """The scene with the small dome at a column, or without it; `other`: another scene altogether."""
    across = np.arange(size) + 0.5
    x, y = np.meshgrid(across - size / 2, size / 2 - across)
    waves = 9.0 if other else 6.0
    height = 0.012 * size * (np.sin(x * waves / size) * np.cos(y * waves / size)) - (x**2 + y**2) / (1.6 * size) * (0.5 if other else 1)
    moving = np.zeros(x.shape, bool)
    texture = np.random.default_rng(3 if other else 2).random((size, size, 1))
    albedo = (np.array([0.3, 0.5, 0.6]) if other else np.array([0.6, 0.5, 0.35])) * (0.8 + 0.4 * texture)
    if place is not None:
        radius = size / 6
        u, v = x - (place - size / 2), y - size / 4
        moving = u**2 + v**2 < (0.85 * radius) ** 2
        ball = np.sqrt(np.maximum(radius**2 - u**2 - v**2, 1))
        height = np.where(moving, ball, height)
        albedo = np.where(moving[..., None], np.array([0.4, 0.45, 0.5]) * (1 + 0.2 * np.sin(u / 3))[..., None], albedo)
    slope_y, slope_x = np.gradient(height)
    if place is not None:
        slope_x, slope_y = np.where(moving, -u / ball, slope_x), np.where(moving, v / ball, slope_y)
    edge = moving & ~(np.roll(moving, 1, 0) & np.roll(moving, -1, 0) & np.roll(moving, 1, 1) & np.roll(moving, -1, 1))
    around = edge | np.roll(edge, 1, 0) | np.roll(edge, -1, 0) | np.roll(edge, 1, 1) | np.roll(edge, -1, 1)
    flat = around & ~moving
    slope_x, slope_y = np.where(flat, 0, slope_x), np.where(flat, 0, slope_y)
    normal = np.stack([-slope_x, slope_y, np.ones_like(x)], axis=-1)
    return Moment(normal / np.linalg.norm(normal, axis=-1, keepdims=True), height * PIXEL_M, albedo, moving)


def write_step(folder: Path, scene: Moment, *, seed: int, noise: float = 0.01, brightness: float | np.ndarray = 1.0,
               **changes: object) -> Path:
    """Write the capture of a step, with noise of this part of the brightest value; its lights are this much brighter than they say."""
    random, images = np.random.default_rng(seed), []
    size, directions = len(scene.normal), lattice(LIGHTS, 50)
    for strength, direction in zip(np.broadcast_to(brightness, LIGHTS), directions, strict=True):
        image = strength * scene.albedo * np.maximum(scene.normal @ direction, 0)[..., None]
        images.append(image + noise * random.normal(size=image.shape) * np.sqrt(image + 0.02) + PEDESTAL)
    write_exr(folder / "dark.exr", np.full((size, size, 3), PEDESTAL))
    camera = {"projection": "orthographic", "resolution": [size, size], "pixel_size_m": PIXEL_M}
    return write_lit(folder, images, [distant(direction, np.pi) for direction in directions], names="{:02d}.exr", **{
        "name": folder.name, "dark": "dark.exr", "camera": camera, **changes})


def write_sequence(folder: Path, places: list[float | None], *, cut: int | None = None, noise: float = 0.01,
                   times: list[float] | None = None, size: int = SIZE, **changes: object) -> list[Moment]:
    """Write a capture a step, from `cut` on of another scene; with times, a sequence.json too."""
    moments = []
    for step, place in enumerate(places):
        scene = moment(place, other=cut is not None and step >= cut, size=size)
        write_step(folder / f"step{step:02d}", scene, seed=100 + step, noise=noise, **changes)
        moments.append(scene)
    if times is not None:
        (folder / "sequence.json").write_text(json.dumps({
            "schema": "relit.sequence/1", "frames_per_second": 30,
            "steps": [{"path": f"step{step:02d}", "time_s": time} for step, time in enumerate(times)]}))
    return moments
