"""Pixels of solved maps to be lit, on a device and as their twin."""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.packs import pack_type
from kernels.relight.model import shading
from kernels.relight.model.captured import Captured
from tests.kernels.scenes import bits, store
from tests.reference.shading import Pixels

FLOAT = 2.0**-24
"""Largest relative error of one float32 operation."""
ROUGHEST, SMOOTHEST = 0.9, 0.3
"""Of scattered pixels. GGX's α² (n·h)² + 1 - (n·h)² is off by some 4 FLOAT and at least α² = 0.3⁴: values by twice 4 FLOAT / 0.3⁴."""
LOBE = 1e-4
"""That, relative."""


def scattered_pixels(count: int, seed: int = 0) -> Pixels:
    """Of any orientation that the viewer sees well, near the origin; float32 values."""
    rng = np.random.default_rng(seed)
    view = rng.normal(size=(count, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    normal = rng.normal(size=(count, 3)) * [0.6, 0.6, 0] + [0, 0, 1]
    view, normal = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (view, normal))
    normal = np.where((normal * view).sum(axis=1, keepdims=True) > 0.2, normal, view)
    return Pixels(*(plane.astype(np.float32) for plane in (
        normal, rng.uniform(0.05, 0.9, (count, 3)), rng.uniform(0.02, 0.9, (count, 3)), rng.uniform(SMOOTHEST, ROUGHEST, count), view,
        rng.uniform(-0.3, 0.3, (count, 3)))))


def facing(count: int = 1, *, normal=(0, 0, 1), albedo=1.0, position=(0, 0, 0)) -> Pixels:
    """Lambertian ones, all alike, seen from +z."""
    return Pixels(*(np.tile(np.float32(plane), (count, 1)) for plane in (normal, [albedo] * 3, [0, 0, 0])), np.zeros(count, np.float32),
                  np.tile(np.float32([0, 0, 1]), (count, 1)), np.tile(np.float32(position), (count, 1)))


def upload(pixels: Pixels, device: str) -> shading.Surface:
    return shading.upload_surface(*pixels, device=device)


def radiance(pixels: Pixels, sources, device: str, visible: np.ndarray | None = None) -> np.ndarray:
    """[6, P] of shading.shade, without padding."""
    packed = None if visible is None else pack_bytes(visible, device)
    return shading.shade(upload(pixels, device), sources, packed).numpy()[:, : len(pixels.normal)]


def pack_bytes(rows: np.ndarray, device: str) -> wp.array:
    """[rows, P] uint8 → packs; the last is filled up with 7."""
    pack = devices.pack_width(device)
    padded = np.pad(rows, ((0, 0), (0, -rows.shape[1] % pack)), constant_values=7)
    return wp.array(padded.reshape(len(rows), -1, pack), dtype=pack_type(pack, wp.uint8), device=device)


def captured(pixels: Pixels, readings: np.ndarray, lights: np.ndarray, irradiance: np.ndarray, device: str, *,
             visible: np.ndarray | None = None, clipped: np.ndarray | None = None) -> tuple[Captured, np.ndarray]:
    """Images of readings [lights, 3, P] beside the pixels, which see all lights where `visible` [lights, P] does not say otherwise; and the
    readings that their stack holds. `clipped` [lights, P]: which readings the sensor cut off."""
    stack, scale, held = stored(readings, irradiance)
    visible = np.full((len(lights), len(pixels.normal)), 255, np.uint8) if visible is None else visible
    band = packs.upload(stack, None if clipped is None else bits(clipped), device=device)
    return Captured.of(band, upload(pixels, device), pack_bytes(visible, device), lights, irradiance, scale), held


def stored(readings: np.ndarray, irradiance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A stack of readings [lights, 3, P]: half values and what a stored 1.0 is worth, unequal among the lights; and what it then holds."""
    count = len(readings)
    scale = np.ones(-(-count // 8) * 8, np.float32)
    scale[:count] = 2.0 ** (np.arange(count) % 5 - 2)
    stack = store(np.einsum("lcp,lc,l->clp", readings, irradiance, 1 / scale[:count]))
    return stack, scale, np.einsum("clp,lc,l->lcp", stack[:, :count].astype(float), 1 / irradiance, scale[:count])
