"""Capture → maps.exr and report.json: normals and albedo band by band, then height."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.photometric.readings import pad_lights
from kernels.status import SOLVED, Status
from kernels.surface.integrate import Integration
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata, report
from service.requests.solve import Method, SolveRequest
from service.solve.causes import name_causes
from service.solve.consistency import Suspect, suspect_lights
from service.solve.distant import solve_normals
from service.solve.extended import solve_extended
from service.solve.gradient import solve_gradients
from service.solve.height import integrate, mark_not_facing
from service.solve.near import solve_near
from service.solve.reference import solve_by_reference
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.errors import ManifestError
from stage.extended_lights import ExtendedLights
from stage.files import write_text
from stage.gradients import GradientFrames, gradient_frames, has_gradients
from stage.ingest import open_stack
from stage.light import ExtendedLight
from stage.lighting import check_solvable
from stage.manifest import FILE_NAME
from stage.maps import MAPS_FILE, SurfaceMaps
from stage.motion.tracking import tracking_frames
from stage.point_lights import DistantLights, PlacedLights
from stage.reference_ball import ReferenceBall, reference_ball

SVBRDF_LIGHTS = 12
"""From this many lights on the general solver is the default: it fits six lobes and a direction to each pixel, and was better than
robust on every object tried with eight to 96 lights (docs/figures.md)."""
REPORT_FILE = "report.json"


class SolveResult(NamedTuple):
    """What a solve made."""

    maps: SurfaceMaps
    maps_path: Path
    report_path: Path
    counts: dict[str, int]
    """Pixels of the mask per status."""
    suspects: tuple[Suspect, ...]
    """Distant lights that disagree with the others."""


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
    if (method is Method.REFERENCE) != (request.reference_ball is not None):
        raise RequestError("--method reference and --reference-ball CAPTURE go together: give both or neither")
    lights: GradientFrames | ReferenceBall | DistantLights | PlacedLights | ExtendedLights
    if method is Method.GRADIENT:
        lights = gradient_frames(capture)
    elif request.reference_ball is not None:
        lights = reference_ball(capture, Capture.open(request.reference_ball))
    else:
        lights = check_solvable(capture)
    if isinstance(lights, ExtendedLights) and method is not Method.SVBRDF:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light: some are extended: --method svbrdf solves these, "
                            f"{method} needs lights of one direction each")
    mask = capture.mask()
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done))
    camera, integration, height = capture.camera, None, None
    suspects: list[Suspect] = []
    if isinstance(lights, PlacedLights):
        solution, height, integration = solve_near(method, stack, lights, camera, mask, device, timings)
    elif isinstance(lights, ExtendedLights):
        solution = solve_extended(stack, lights, camera, mask, device, timings)
    elif isinstance(lights, ReferenceBall):
        solution = solve_by_reference(stack, lights, camera, mask, request.cache, device, timings)
    elif isinstance(lights, GradientFrames):
        solution = solve_gradients(lights, stack, camera, mask, device, timings)
    else:
        padded = pad_lights(lights.direction, lights.irradiance, stack.scale)
        solution = solve_normals(method, stack, padded, camera, mask, device, timings)
        suspects = suspect_lights(solution, stack, padded)
    rows, cols = mask.shape
    status = solution.status.reshape(rows, cols)
    mark_not_facing(camera, solution)
    name_causes(solution, stack)
    solved = np.isin(status, SOLVED)
    if integration is None:
        timings.stage("height", 100)
        integration = integrate(camera, solution.normal, solved, device, lambda part: timings.advance(round(100 * part)))

    def image(planes: np.ndarray | None) -> np.ndarray | None:
        if planes is None:
            return None
        return planes.reshape(rows, cols) if planes.ndim == 1 else np.moveaxis(planes.reshape(-1, rows, cols), 0, -1)

    maps = SurfaceMaps(
        camera=camera,
        mask=solved,
        normal=image(solution.normal),
        diffuse_albedo=None if method is Method.REFERENCE else image(solution.albedo),
        specular=image(solution.specular),
        roughness=image(solution.roughness),
        regime=image(solution.regime),
        specular_normal=image(solution.specular_normal),
        height=integration.height.numpy() if height is None and integration is not None else height,
        confidence=image(solution.confidence),
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
        options=request.model_dump(mode="json", include={"method", *(("reference_ball",) if request.reference_ball else ()),
                                                         *(("align", "align_to") if request.aligned else ())}),
        found=solution.facts,
        suspect_lights=[suspect._asdict() for suspect in suspects],
        device=devices.describe(device),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        residual=_residual_statistics(solution.residual.reshape(rows, cols)[solved]),
        albedo_above_one=int((maps.diffuse_albedo[solved] > 1).any(axis=-1).sum()) if maps.diffuse_albedo is not None else 0,
        height=_height_report(integration, capture),
        **({} if stack.motion is None else {"motion": stack.motion}),
    ))
    return SolveResult(maps, maps_path, report_path, counts, tuple(suspects))


def _default_method(capture: Capture) -> Method:
    if has_gradients(capture):
        return Method.GRADIENT
    if capture.lit_by(ExtendedLight):
        return Method.SVBRDF
    return Method.SVBRDF if len(capture.sources()) >= SVBRDF_LIGHTS else Method.ROBUST


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
