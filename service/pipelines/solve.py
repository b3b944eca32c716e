"""Capture → maps.exr and report.json: normals and albedo band by band, then height."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels import packs
from kernels.photometric.albedo import fit_albedo
from kernels.photometric.lambert import solve_lambert
from kernels.photometric.readings import Lights, grey_factors, grey_readings, pad_lights
from kernels.photometric.robust import solve_robust
from kernels.status import Status
from kernels.surface.integrate import Integration, IntegrationOptions, integrate_normals
from service.methods import Method
from service.progress import Progress, Timings
from service.provenance import metadata, report
from service.requests import SolveRequest
from stage.capture import Capture
from stage.colour import GREY_WEIGHTS, linear_space
from stage.files import write_text
from stage.ingest import open_stack
from stage.lighting import check_solvable
from stage.maps import SurfaceMaps
from stage.stack import Stack

SOLVERS = {Method.LAMBERT: solve_lambert, Method.ROBUST: solve_robust}
READING_BYTES = 4
"""A grey reading, per light and pixel, beside the stack's band."""
INTEGRATION = IntegrationOptions(discontinuities=True, max_reweightings=0)
"""The surface may break where slopes around a pixel contradict each other: objects hide parts of themselves. The bilateral rounds
that may follow gain little more on real objects and can settle on a wrong break where normals are noisy (docs/figures.md)."""
MAPS_FILE, REPORT_FILE = "maps.exr", "report.json"


class SolveResult(NamedTuple):
    """What a solve made."""

    maps: SurfaceMaps
    maps_path: Path
    report_path: Path
    counts: dict[str, int]
    """Pixels of the mask per status."""


class _Solution(NamedTuple):
    normal: np.ndarray  # [3, pixels] float32
    albedo: np.ndarray  # [3, pixels] float16
    confidence: np.ndarray  # [pixels] float16
    residual: np.ndarray  # [pixels] float16
    status: np.ndarray  # [pixels] uint8


def solve(request: SolveRequest, progress: Progress | None = None) -> SolveResult:
    """Solve a capture.

    Args:
        request: what to solve and where to put it.
        progress: told of every stage.

    Raises:
        StageError, KernelError: bad input; nothing is written.
        StorageError: the results cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    lights = check_solvable(capture)
    mask = capture.mask()
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, progress=lambda done, _: timings.advance(done))
    padded = pad_lights(lights.direction, lights.irradiance, stack.scale)
    timings.stage("normals", stack.shape[2])
    solution = _solve_bands(request.method, stack, padded, mask, device, timings)
    rows, cols = mask.shape
    status = solution.status.reshape(rows, cols)
    normal = np.moveaxis(solution.normal.reshape(3, rows, cols), 0, -1)
    _mark_not_facing(capture, normal, status)
    solved = status == Status.OK
    timings.stage("height", 100)
    integration = _integrate(capture, solution.normal.reshape(3, rows, cols), solved, device, timings)
    maps = SurfaceMaps(
        camera=capture.camera,
        mask=solved,
        normal=normal,
        diffuse_albedo=np.moveaxis(solution.albedo.reshape(3, rows, cols), 0, -1),
        height=None if integration is None else integration.height.numpy(),
        confidence=solution.confidence.reshape(rows, cols),
        color_space=linear_space(capture.manifest.color_space),
        provenance=metadata(request, capture=capture.name, inputs=stack.key),
    )
    timings.stage("write", 1)
    maps_path, report_path = request.out / MAPS_FILE, request.out / REPORT_FILE
    maps.write(maps_path)
    counts = {s.name.lower(): int(np.count_nonzero(status[mask] == s)) for s in Status}
    write_text(report_path, report(
        inputs={"capture": str(request.capture), "name": capture.name, "content": stack.key, "frames": len(stack.frames),
                "resolution": list(capture.camera.resolution), "color_space": capture.manifest.color_space},
        method=str(request.method),
        options=request.model_dump(mode="json", include={"method"}),
        device=devices.describe(device),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        residual=_residual_statistics(solution.residual.reshape(rows, cols)[solved]),
        albedo_above_one=int((maps.diffuse_albedo[solved] > 1).any(axis=-1).sum()) if maps.diffuse_albedo is not None else 0,
        height=_height_report(integration, capture),
    ))
    return SolveResult(maps, maps_path, report_path, counts)


def _solve_bands(method: Method, stack: Stack, lights: Lights, mask: np.ndarray, device: str, timings: Timings) -> _Solution:
    pixels = stack.pixel_count
    result = _Solution(np.zeros((3, pixels), np.float32), np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16),
                       np.zeros(pixels, np.float16), np.zeros(pixels, np.uint8))
    factors = grey_factors(lights, GREY_WEIGHTS)
    inside = mask.reshape(-1)
    for start, stop in stack.bands(READING_BYTES * stack.shape[1]):
        here = slice(start, min(stop, pixels))
        if inside[here].any():
            band = packs.upload(stack.band(start, stop), stack.saturated(start, stop), device=device)
            readings = grey_readings(band, factors)
            fit = SOLVERS[method](band, readings, lights.direction)
            albedo = fit_albedo(band, readings, fit, lights)
            count = here.stop - start
            kept = inside[here]
            result.normal[:, here] = np.where(kept, fit.normal.numpy()[:, :count], 0)
            result.albedo[:, here] = np.where(kept, albedo.numpy()[:, :count], 0)
            result.confidence[here] = np.where(kept, fit.confidence.numpy()[:count], 0)
            result.residual[here] = np.where(kept, fit.residual.numpy()[:count], 0)
            result.status[here] = np.where(kept, fit.status.numpy()[:count], int(Status.UNSOLVED))
        timings.advance(stop)
    return result


def _mark_not_facing(capture: Capture, normal: np.ndarray, status: np.ndarray) -> None:
    """A visible surface faces its line of sight: pixels whose normal does not are not solved."""
    toward = normal[..., 2]
    if capture.camera.projection == "perspective":
        x, y = capture.camera.plane_coordinates()
        toward = normal[..., 2] - normal[..., 0] * x - normal[..., 1] * y
    status[(status == Status.OK) & (toward <= 0)] = Status.NOT_FACING


def _integrate(capture: Capture, normal: np.ndarray, solved: np.ndarray, device: str, timings: Timings) -> Integration | None:
    """Height of the solved pixels; None when there is none."""
    if not solved.any():
        return None
    camera = capture.camera
    perspective = camera.projection == "perspective"
    mean_z = camera.surface_z_m or 0.0
    if perspective and camera.surface_z_m is None:
        assert camera.focal_px is not None
        mean_z = -sum(camera.focal_px) / 2  # at this distance one pixel spans one unit
    x, y = camera.plane_coordinates()
    return integrate_normals(normal, solved, x.astype(np.float32), y.astype(np.float32), perspective=perspective, mean_z=mean_z,
                             options=INTEGRATION, device=device, progress=lambda part: timings.advance(round(100 * part)))


def _residual_statistics(residual: np.ndarray) -> dict[str, float]:
    """Of the relative residual of each solved pixel's lit readings."""
    if residual.size == 0:
        return {}
    values = np.percentile(residual.astype(np.float32), [50, 95])
    return {"median": round(float(values[0]), 5), "p95": round(float(values[1]), 5)}


def _height_report(integration: Integration | None, capture: Capture) -> dict[str, Any]:
    if integration is None:
        return {}
    return {"unit": "m" if capture.camera.metric else "pixel", "iterations": integration.iterations,
            "relative_residual": float(integration.residual), "converged": bool(integration.converged)}
