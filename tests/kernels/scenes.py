"""Lambertian pixels with a closed form, stored as a stack stores them, and one call that solves them."""

from typing import NamedTuple

import numpy as np

from kernels import packs
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.model.misfit import Misfit, standard_error

GREY = (0.2126, 0.7152, 0.0722)
HALF_ROUNDING = 2.0**-11
"""Largest relative error of a half value."""
HALF_STEP = 2.0**-25
"""Largest error of one below the normal range."""


class Solved(NamedTuple):
    normal: np.ndarray  # [pixel, 3]
    albedo: np.ndarray  # [pixel, 3]
    residual: np.ndarray  # [pixel]
    status: np.ndarray  # [pixel]
    across: np.ndarray  # [pixel]
    squares: np.ndarray  # [pixel]
    freedom: np.ndarray  # [pixel]
    spare: np.ndarray  # [pixel]
    agreeing: np.ndarray  # [pixel]
    weights: np.ndarray  # [light, pixel]

    def sigma(self, misfit: Misfit = Misfit()) -> np.ndarray:  # noqa: B008  (immutable)
        """Return the standard error of the normals in degrees, [pixel]."""
        return standard_error(self.across, self.squares, self.freedom, self.spare, self.agreeing, misfit)


def colours(count: int, channels: int = 3, seed: int = 0) -> np.ndarray:
    """[count, channels]: albedos, or with a factor irradiances, unequal in every channel."""
    return np.random.default_rng(seed).uniform(0.2, 0.9, (count, channels))


def shade(normal: np.ndarray, albedo: np.ndarray, direction: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """[3, light, pixel] float64: ρ/π · E · max(0, n·l)."""
    cosine = np.maximum(direction @ normal.T, 0)
    return np.einsum("lp,pc,lc->clp", cosine, albedo, irradiance) / np.pi


def store(radiance: np.ndarray) -> np.ndarray:
    """[3, light, pixel] as half, lights padded with zeros to a multiple of 8."""
    return np.pad(radiance, ((0, 0), (0, -radiance.shape[1] % 8), (0, 0))).astype(np.float16)


def bits(saturated: np.ndarray) -> np.ndarray:
    """[light / 8, pixel] uint8 of [light, pixel] bool: bit l % 8 of byte l // 8."""
    padded = np.pad(saturated, ((0, -saturated.shape[0] % 8), (0, 0)))
    return np.packbits(padded, axis=0, bitorder="little")


def solve(solver, radiance: np.ndarray, direction: np.ndarray, irradiance: np.ndarray, device: str, *, saturated=None) -> Solved:
    """Store the radiance [3, light, pixel], solve it, and bring everything back without padding."""
    _, count, pixels = radiance.shape
    lights = pad_lights(direction, irradiance)
    band = packs.upload(store(radiance), None if saturated is None else bits(saturated), device=device)
    readings = grey_readings(band, grey_factors(lights, GREY))
    fit = solver(band, readings, lights.direction)
    albedo = fit_albedo(band, readings, fit, lights).albedo
    scalars = (array.numpy()[:pixels] for array in fit[1:])
    return Solved(fit.normal.numpy()[:, :pixels].T, albedo.numpy()[:, :pixels].T, *scalars, unpack(readings, band)[:count, :pixels])


def unpack(readings, band) -> np.ndarray:
    """[light padded, pixel padded] of readings, whichever way round they lie."""
    values = readings.values.numpy()
    pack = values.shape[1]
    if readings.light_stride == 1:
        return values.reshape(band.packs, band.frame_count, pack).transpose(1, 0, 2).reshape(band.frame_count, -1)
    return values.reshape(band.frame_count, band.packs * pack)


def angle_degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Between the rows of a and b; by the half chord, which does not cancel at small angles."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2, 0, 1)))


def rounding_bounds(normal, albedo, direction, irradiance, used) -> tuple[np.ndarray, np.ndarray]:
    """What half rounding can do at most to a least-squares fit of the lights used [light, pixel].

    A reading y moves by at most 2⁻¹¹ y, so b = G⁻¹ Σ l y moves across the normal by at most 2⁻¹¹ Σ |P G⁻¹ l| y, and the
    normal by that over |b|. The albedo moves by 2⁻¹¹ of itself, and with the normal by Σ E² cos / Σ E² cos² of its angle.

    Returns:
        Angle [pixel] in degrees and relative error of the albedo [pixel].
    """
    angle, relative = np.zeros(len(normal)), np.zeros(len(normal))
    for p, n in enumerate(normal):
        lights = direction[used[:, p]]
        cosine = np.maximum(lights @ n, 0)
        solve_row = lights @ np.linalg.inv(lights.T @ lights)
        across = solve_row - np.outer(solve_row @ n, n)
        smallest = (irradiance[used[:, p]] * albedo[p]).min(axis=1) / np.pi
        step = HALF_ROUNDING * cosine + HALF_STEP / smallest
        turn = (np.linalg.norm(across, axis=1) * step).sum()
        angle[p] = np.degrees(turn)
        e2 = irradiance[used[:, p]] ** 2
        relative[p] = HALF_ROUNDING + turn * ((e2 * cosine[:, None]).sum(0) / (e2 * cosine[:, None] ** 2).sum(0)).max()
    return angle, relative
