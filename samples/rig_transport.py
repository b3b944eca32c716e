"""Light transport of the rig: what every camera pixel receives of every projector column, row and laser spot, path traced.

Light is additive, so a picture under any pattern that is constant along one axis is a sum over columns or rows; one set of paths serves
them all, and the pictures of different codes differ in nothing but the code.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rig_scene
from rig_scene import Rig

MAX_DEPTH = 6  # longest path, in segments
STRATA = 12  # per pixel side and pass: bounds the memory of one wavefront, and one pass's direct light is nearly without noise
SPOT_START_PX, SPOT_STEP_PX, SPOT_GRID = (14.5, 12.5), (28.0, 27.0), (9, 7)
SPOT_SIGMA_PX = 0.9
WAVE_PERIOD_PX, CARRIER_PERIOD_PX = 256.0, 8.0  # of modulated phase shifting, along and across columns
AMBIENT_PASSES = 8


class Transport(NamedTuple):
    """Radiance at each camera pixel, row by row, with the projector fully on."""

    columns: np.ndarray  # [pixels, WIDTH] float32: through each projector column
    rows: np.ndarray  # [pixels, HEIGHT] float32
    spots: np.ndarray  # [pixels, spots] float32: through Gaussian spots
    waves: np.ndarray  # [pixels, 9] float32: through {1, cos, sin}(2πu/WAVE_PERIOD_PX) × {1, cos, sin}(2πv/CARRIER_PERIOD_PX)
    direct: np.ndarray  # [pixels] float32: the part that came without a bounce in between
    ambient: np.ndarray  # [pixels] float32: projector black


def spot_positions() -> np.ndarray:  # -> [spots, 2] projector pixels
    """Return the projector coordinates of the laser spots."""
    across, down = SPOT_GRID
    j, i = np.mgrid[:down, :across]
    return np.stack([SPOT_START_PX[0] + SPOT_STEP_PX[0] * i, SPOT_START_PX[1] + SPOT_STEP_PX[1] * j], -1).reshape(-1, 2)


def camera_rays(mi, rig: Rig, u: np.ndarray | Any, v: np.ndarray | Any) -> Any:
    """Return Mitsuba rays through continuous image coordinates."""
    import drjit as dr

    x, y = rig.camera.plane_at(u, v)  # arithmetic only: Dr.Jit's numbers pass through
    direction = mi.Vector3f(mi.Float(x), mi.Float(y), -1.0)
    return mi.Ray3f(mi.Point3f(0.0), dr.normalize(direction))


def vertices(mi, scene, ray, random, *, max_depth: int = MAX_DEPTH) -> Iterator[tuple[int, Any, Any]]:
    """Path trace, and at every surface point take the light that comes straight from the emitter.

    Yields:
        segments so far, the emitter's (u, v) in 0…1, and the radiance that this adds to the pixel.
    """
    throughput, active = mi.Float(1.0), mi.Bool(True)
    context = mi.BSDFContext()

    def two() -> Any:
        return mi.Point2f(random.next_float32(), random.next_float32())

    for segments in range(2, max_depth + 1):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        sample, arriving = scene.sample_emitter_direction(si, two(), True, active)
        reflected = bsdf.eval(context, si, si.to_local(sample.d), active)
        yield segments, sample.uv, mi.Float((throughput * reflected * arriving)[0])
        if segments < max_depth:
            bounce, weight = bsdf.sample(context, si, random.next_float32(), two(), active)
            throughput = throughput * weight[0]
            ray = si.spawn_ray(si.to_world(bounce.wo))


def _primary(mi, rig: Rig, seed: int) -> tuple[Any, Any, Any]:
    """Return pixel numbers, rays spread evenly over each pixel, and random numbers."""
    import drjit as dr

    count = STRATA * STRATA
    index = dr.arange(mi.UInt32, rig.camera.width * rig.camera.height * count)
    random = mi.PCG32(size=dr.width(index), initstate=seed)
    pixel, stratum = index // count, index % count
    u = mi.Float(pixel % rig.camera.width) + (mi.Float(stratum % STRATA) + random.next_float32()) / STRATA
    v = mi.Float(pixel // rig.camera.width) + (mi.Float(stratum // STRATA) + random.next_float32()) / STRATA
    return pixel, camera_rays(mi, rig, u, v), random


def trace_pass(mi, scene, rig: Rig, seed: int, *, max_depth: int = MAX_DEPTH) -> dict[str, np.ndarray]:
    """Return the sums of one pass over STRATA² paths a pixel: an undivided Transport without ambient light."""
    import drjit as dr

    pixels, (width, height) = rig.camera.width * rig.camera.height, rig.projector.resolution
    spots = SPOT_GRID[0] * SPOT_GRID[1]
    sums = {name: dr.zeros(mi.Float, pixels * n) for name, n in
            (("columns", width), ("rows", height), ("spots", spots), ("waves", 9), ("direct", 1))}  # fmt: skip
    pixel, ray, random = _primary(mi, rig, seed)
    (fx, fy), (wide, high) = rig.projector.focal_px, rig_scene.EMITTER_RESOLUTION

    def nearest(at: Any, count: int) -> list[tuple[Any, Any]]:
        """Return the two projector pixels with the nearest centres and their weights, for bilinear patterns."""
        first = dr.floor(at - 0.5)
        share = at - 0.5 - first
        cells = [mi.UInt32(dr.clip(mi.Int32(first) + offset, 0, count - 1)) for offset in (0, 1)]
        return [(cells[0], 1 - share), (cells[1], share)]

    def wave(cells: list[tuple[Any, Any]], period: float) -> tuple[Any, ...]:
        angles = [(2 * np.pi / period * (mi.Float(cell) + 0.5), weight) for cell, weight in cells]
        return 1.0, sum(w * dr.cos(a) for a, w in angles), sum(w * dr.sin(a) for a, w in angles)

    for segments, uv, value in vertices(mi, scene, ray, random, max_depth=max_depth):
        u, v = rig_scene.panel_at(rig.projector, (uv.x - 0.5) * wide / fx, (uv.y - 0.5) * high / fy)
        on_panel = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (value > 0)
        across, down = nearest(u, width), nearest(v, height)
        for name, cells, count in (("columns", across, width), ("rows", down, height)):
            for cell, weight in cells:
                dr.scatter_add(sums[name], value * weight, pixel * count + cell, on_panel)
        for number, (along, over) in enumerate(product(wave(across, WAVE_PERIOD_PX), wave(down, CARRIER_PERIOD_PX))):
            dr.scatter_add(sums["waves"], value * along * over, pixel * 9 + number, on_panel)
        if segments == 2:
            dr.scatter_add(sums["direct"], value, pixel, on_panel)
        i = dr.clip(dr.round((u - SPOT_START_PX[0]) / SPOT_STEP_PX[0]), 0, SPOT_GRID[0] - 1)
        j = dr.clip(dr.round((v - SPOT_START_PX[1]) / SPOT_STEP_PX[1]), 0, SPOT_GRID[1] - 1)
        du, dv = u - SPOT_START_PX[0] - SPOT_STEP_PX[0] * i, v - SPOT_START_PX[1] - SPOT_STEP_PX[1] * j
        weight = dr.exp(-0.5 * (du * du + dv * dv) / SPOT_SIGMA_PX**2)
        dr.scatter_add(sums["spots"], value * weight, pixel * spots + mi.UInt32(j * SPOT_GRID[0] + i), on_panel & (weight > 1e-6))
    dr.eval(*sums.values())
    return {name: np.array(total).reshape(pixels, -1) for name, total in sums.items()}


def trace_ambient(mi, shapes: dict, rig: Rig, *, seed: int) -> np.ndarray:
    """Return the radiance [pixels] under the ambient light alone."""
    import drjit as dr

    scene = mi.load_dict({"type": "scene", **shapes, "sky": {"type": "constant", "radiance": rig_scene.AMBIENT_RADIANCE}})
    pixels, total = rig.camera.width * rig.camera.height, 0.0
    for number in range(AMBIENT_PASSES):
        pixel, ray, random = _primary(mi, rig, seed + number)
        image = dr.zeros(mi.Float, pixels)
        for _, _, value in vertices(mi, scene, ray, random):
            dr.scatter_add(image, value, pixel)
        total = total + np.array(image, dtype=np.float64)
    return (total / (AMBIENT_PASSES * STRATA**2)).astype(np.float32)


def render_transport(mi, shapes: dict, rig: Rig, path: Path, *, passes: int) -> Transport:
    """Trace what is still missing of `passes` passes, keeping the sums in one file that a later run goes on from."""
    devices = [device.model_dump(mode="json", exclude_none=True) for device in rig]
    settings = json.dumps([devices, STRATA, MAX_DEPTH, spot_positions().tolist(), rig_scene.IRRADIANCE, rig_scene.AMBIENT_RADIANCE])
    sums: dict[str, np.ndarray] = {}
    done = 0
    if path.exists():
        with np.load(path) as kept:
            if str(kept["settings"]) != settings:
                raise SystemExit(f"{path} was rendered of another rig: remove it, or give another --work.")
            done, sums = int(kept["passes"]), {name: kept[name] for name in Transport._fields}
    if done < passes:
        scene = mi.load_dict({"type": "scene", **shapes, "projector": rig_scene.emitter(mi, rig.projector)})
        began, first = time.perf_counter(), done
        if not sums:
            sums = {"ambient": trace_ambient(mi, shapes, rig, seed=9000)}
        while done < passes:
            for name, values in trace_pass(mi, scene, rig, done + 1).items():
                sums[name] = values if name not in sums else sums[name] + values
            done += 1
            each = (time.perf_counter() - began) / (done - first)
            print(f"transport: pass {done} of {passes}, {each:.1f} s each", flush=True)
            if done % 8 == 0 or done == passes:
                temporary = path.with_name(f".{path.stem}.part.npz")
                np.savez(temporary, settings=settings, passes=done, **sums)
                os.replace(temporary, path)
    scale = 1 / (done * STRATA**2)
    lit = {name: sums[name] * np.float32(scale) for name in ("columns", "rows", "spots", "waves")}
    return Transport(**lit, direct=sums["direct"][:, 0] * np.float32(scale), ambient=sums["ambient"])
