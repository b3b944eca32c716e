"""Capture → maps.exr and report.json: normals and albedo band by band, then height."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.photometric.readings import pad_lights
from kernels.status import Status
from kernels.surface.integrate import Integration, IntegrationOptions, integrate_normals
from service.methods import Method
from service.pipelines.gradient import solve_gradients
from service.pipelines.normals import solve_normals
from service.progress import Progress, Timings
from service.provenance import metadata, report
from service.requests import SolveRequest
from stage.capture import Capture
from stage.colour import linear_space
from stage.files import write_text
from stage.gradients import GradientFrames, gradient_frames, has_gradients
from stage.ingest import open_stack
from stage.lighting import check_solvable
from stage.maps import SurfaceMaps

SVBRDF_LIGHTS = 12
"""From this many lights on the general solver is the default: it fits six lobes and a direction to each pixel, and was better than
robust on every object tried with eight to 96 lights (docs/figures.md)."""
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
    method = request.method or _default_method(capture)
    lights = gradient_frames(capture) if method is Method.GRADIENT else check_solvable(capture)
    mask = capture.mask()
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, progress=lambda done, _: timings.advance(done))
    if isinstance(lights, GradientFrames):
        solution = solve_gradients(lights, stack, capture.camera, mask, device, timings)
    else:
        padded = pad_lights(lights.direction, lights.irradiance, stack.scale)
        solution = solve_normals(method, stack, padded, capture.camera, mask, device, timings)
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
        specular=None if solution.specular is None else np.moveaxis(solution.specular.reshape(3, rows, cols), 0, -1),
        roughness=None if solution.roughness is None else solution.roughness.reshape(rows, cols),
        specular_normal=None if solution.specular_normal is None else np.moveaxis(
            solution.specular_normal.reshape(3, rows, cols), 0, -1),
        height=None if integration is None else integration.height.numpy(),
        confidence=solution.confidence.reshape(rows, cols),
        color_space=linear_space(capture.manifest.color_space),
        provenance=metadata(request, method=method, capture=capture.name, inputs=stack.key),
    )
    timings.stage("write", 1)
    maps_path, report_path = request.out / MAPS_FILE, request.out / REPORT_FILE
    maps.write(maps_path)
    counts = {s.name.lower(): int(np.count_nonzero(status[mask] == s)) for s in Status}
    write_text(report_path, report(
        inputs={"capture": str(request.capture), "name": capture.name, "content": stack.key, "frames": len(stack.frames),
                "resolution": list(capture.camera.resolution), "color_space": capture.manifest.color_space},
        method=str(method),
        options=request.model_dump(mode="json", include={"method"}),
        found=solution.facts or {},
        device=devices.describe(device),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        residual=_residual_statistics(solution.residual.reshape(rows, cols)[solved]),
        albedo_above_one=int((maps.diffuse_albedo[solved] > 1).any(axis=-1).sum()) if maps.diffuse_albedo is not None else 0,
        height=_height_report(integration, capture),
    ))
    return SolveResult(maps, maps_path, report_path, counts)


def _default_method(capture: Capture) -> Method:
    if has_gradients(capture):
        return Method.GRADIENT
    return Method.SVBRDF if len(capture.sources()) >= SVBRDF_LIGHTS else Method.ROBUST


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
