"""Overlapping feathers and soft noise as functions on a surface: the owl's relief and paint."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Feathers(NamedTuple):
    """The topmost feather at each point."""

    along: np.ndarray  # [N] 0 at the root, 1 at the tip's edge
    across: np.ndarray  # [N] -1..1 from the left to the right border
    number: np.ndarray  # [N] 0..1, one random number per feather
    row: np.ndarray  # [N] int, rows counted downwards


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Return 0 below `low`, 1 above `high`, and a cubic between them (`low` may exceed `high`)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a, b, weight: np.ndarray) -> np.ndarray:
    """Blend scalars or colours (colours along a last axis) by `weight` [N]."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    weight = weight[..., None] if max(a.ndim, b.ndim) and (a.shape[-1:] == (3,) or b.shape[-1:] == (3,)) else weight
    return a + (b - a) * weight


def hash01(*keys: np.ndarray) -> np.ndarray:
    """Return a repeatable random number in 0..1 for integer keys."""
    mixed = sum(k * f for k, f in zip(keys, (12.9898, 78.233, 37.719), strict=False))
    return np.mod(np.sin(mixed) * 43758.5453, 1.0)


def noise(points: np.ndarray, wavelength: float, *, seed: int = 0, waves: int = 24) -> np.ndarray:
    """Smooth random field of unit variance: a sum of sine waves near one wavelength."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    k = direction * (2 * np.pi / wavelength * rng.uniform(0.6, 1.6, (waves, 1)))
    phase = rng.uniform(0, 2 * np.pi, waves)
    total = np.zeros(len(points))
    for wave in range(waves):
        total += np.sin(points @ k[wave] + phase[wave])
    return total * np.sqrt(2 / waves)


def lay(u: np.ndarray, v: np.ndarray, *, reach: float = 2.2, taper: float = 0.35, width: float = 1.25) -> Feathers:
    """Cover a surface with feathers, upper rows over lower ones.

    Args:
        u: [N] across, in feather spacings.
        v: [N] down, in row spacings.
        reach: length of a feather in rows; at least 1 / (1 - taper), or bare skin shows.
        taper: how much shorter a feather is at its borders than at its middle.
        width: of a feather in spacings.
    """
    n = len(u)
    along, across, number = np.zeros(n), np.zeros(n), np.zeros(n)
    row_of, done = np.zeros(n, int), np.zeros(n, bool)
    for back in range(int(np.ceil(reach)), -1, -1):
        row = np.floor(v) - back
        offset = 0.5 * np.mod(row, 2) + 0.18 * (hash01(row, row * 0 + 3) - 0.5)
        nearest = np.floor(u - offset + 0.5)
        for column in (nearest, nearest - 1, nearest + 1):
            key = hash01(row, column)
            s = (u - offset - column) / (0.5 * width) + 0.12 * (key - 0.5)
            end = (reach + 0.25 * (key - 0.5)) * (1 - taper * np.abs(s) ** 2.4)
            t = v - row
            new = ~done & (np.abs(s) <= 1) & (t < end) & (t >= 0)
            along[new] = (t / np.maximum(end, 1e-6))[new]
            across[new], number[new], row_of[new] = s[new], key[new], row[new].astype(int)
            done |= new
    return Feathers(along, across, number, row_of)


def relief(feathers: Feathers, *, thickness: float, barbs: float = 0.06, barb_count: float = 9.0) -> np.ndarray:
    """Return the height of the feathers above the skin, in the unit of `thickness`."""
    t, s = feathers.along, feathers.across
    lift = 0.25 + 0.75 * t**1.3
    edge = 1 - 0.55 * smoothstep(0.86, 1.0, t)
    camber = 1 - 0.35 * s**2
    shaft = 0.14 * np.exp(-((s / 0.09) ** 2)) * (1 - t)
    grooves = barbs * np.sin(2 * np.pi * barb_count * (0.8 * t - 0.55 * np.abs(s)))
    tilt = 0.25 * (feathers.number - 0.5) * t
    return thickness * (lift * edge * camber + shaft + grooves * (0.3 + 0.7 * t) + tilt)
