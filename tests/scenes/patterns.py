"""A synthetic camera under projected patterns: each pixel sees one place of the projector, or the light of several."""

import numpy as np

from kernels.structured.pattern_frames import NoiseModel, upload
from stage.patterns.modulated import ModulatedPattern

NOISE = NoiseModel(0.004, 1.0e-4)
BOUNCE_PX = 60.0
"""How far light is spread by the other surface: wider than fine patterns, narrower than coarse ones."""


def places(count, extent, seed=0):
    """[count] places over the projector, none within a thousandth of a pixel of its border."""
    return np.random.default_rng(seed).uniform(1e-3, extent - 1e-3, count)


def view(patterns, u, extent, *, albedo=0.7, ambient=0.05, bounce=0.0, noise=None, crosstalk=None, seed=1, v=None, blur=0.0):
    """[frames, pixels] or, under colours, [frames, 3, pixels] float64: ambient + albedo · (light + bounce · spread light).

    Args:
        u: [pixels] places along the axis of the code; v across it, for modulated patterns.
        bounce: light that comes over another surface, facing this one at the mirrored place, as a part of the direct light.
        blur: width of the pixel's footprint, projector pixels.
    """
    rng, images = np.random.default_rng(seed), []
    for pattern in patterns:
        def light(at, pattern=pattern):
            return pattern.level(at, v, extent)

        shifts = (np.arange(10) - 4.5) / 10 * blur if blur else [0.0]
        seen = np.mean([light(np.clip(u + s, 0, extent - 1e-6)) for s in shifts], axis=0)
        if bounce:
            grid = np.arange(0, extent, 0.5)
            if isinstance(pattern, ModulatedPattern):  # the carrier, finer than the spread, is even there
                line = (1 + np.cos(2 * np.pi * (grid / pattern.period_px - pattern.step / pattern.steps))) / 4
            else:
                line = pattern.level(grid, v, extent)
            kernel = np.exp(-0.5 * ((np.arange(-480, 481) * 0.5) / BOUNCE_PX) ** 2)
            padded = np.pad(line, 480, mode="edge")
            spread = np.convolve(padded, kernel / kernel.sum(), mode="valid")
            seen = seen + bounce * np.interp(extent - u, grid, spread)
        images.append(seen)
    colour = any(image.ndim == 2 for image in images)
    if colour:
        images = [image if image.ndim == 2 else np.repeat(image[:, None], 3, axis=1) for image in images]
    stack = np.stack(images)
    if crosstalk is not None:
        stack = stack @ crosstalk.T
    stack = ambient + np.asarray(albedo) * stack if not colour else ambient + stack * np.broadcast_to(albedo, (len(u), 3))
    if noise is not None:
        stack = stack + rng.normal(size=stack.shape) * np.sqrt(noise.read**2 + noise.gain * np.maximum(stack, 0))
    return np.moveaxis(stack, -1, 1) if colour else stack


def frames_of(stack, device, saturated=None):
    """Frames on the device, of [frames, (3,) pixels]."""
    return upload(np.ascontiguousarray(stack, dtype=np.float32), saturated, device=device)


def result(decoded, count):
    """Coordinate, sigma, amplitude and status as NumPy arrays, without padding."""
    return tuple(array.numpy()[:count] for array in decoded)
