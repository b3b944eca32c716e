"""Join solved maps and a depth of the same view: maps.exr with the height of both, and normals without their drift."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.status import Status
from service.errors import RequestError
from service.joining.depth_and_normals import ROUNDED, Joined, join_depth
from service.light_estimation.lambertian import degrees_between
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.solve import JoinRequest
from service.solve.height.parts import numbered
from stage.capture.camera import Camera
from stage.errors import ResultError
from stage.files import write_text
from stage.results.depth_maps import CALIBRATION_SIGMA, DEPTH_FILE, DepthMaps
from stage.results.maps import JOINED, MAPS_FILE, SurfaceMaps
from stage.results.result_metadata import result_file
from stage.stack.fingerprint import digest

CAMERA_TOLERANCE = 1e-3
"""Largest difference of a number of the two cameras, pixels or parts of it: both results have them from manifests."""
ROUNDING = 1e-9
"""What rounding leaves of a number of a pose or a distortion that is 0."""
CONTRADICTION = 0.5
"""Part of the relief of the depth that normals may leave unexplained before the two are refused as not of one surface: it is below .1
where they are, and above 1 where the normals point another way."""
NOISIER, SHARED = 1.5, 0.5
"""Noise of the depth over its standard deviation, and errors that neighbours share over that, from which they are said."""
MANY = 0.1
"""Part of the surface without a place of its own before it is said."""


class JoinResult(NamedTuple):
    """The files of a joined surface, and what its user should know."""

    maps_path: Path
    report_path: Path
    facts: dict[str, Any]
    warnings: tuple[str, ...]


def join(request: JoinRequest, progress: Progress | None = None) -> JoinResult:
    """Join solved maps with a depth.
    Raises RequestError if the two are not of one camera, do not overlap, or contradict each other; or the output would replace an input."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    maps_file = result_file(request.maps, MAPS_FILE, command="relit solve")
    depth_file = result_file(request.depth, DEPTH_FILE, command="relit depth")
    target = request.out / MAPS_FILE
    if target.exists() and target.samefile(maps_file):
        raise RequestError(f"--out {request.out}: would replace {maps_file}, which is joined: give another folder")
    maps, depth = SurfaceMaps.read(maps_file), DepthMaps.read(depth_file)
    for name, found, file in (("normal", maps.normal, maps_file), ("sigma", maps.sigma, maps_file), ("sigma", depth.sigma, depth_file)):
        if found is None:
            raise ResultError(f"{file}: has no layer {name}, which joining needs")
    assert maps.normal is not None and maps.sigma is not None and depth.sigma is not None
    _check_cameras(maps.camera, depth.camera, maps_file, depth_file)
    measured = depth.mask & (depth.sigma > 0)
    overlap = int((maps.mask & measured).sum())
    if overlap == 0:
        raise RequestError(f"{depth_file}: no pixel with a depth has a normal in {maps_file}")
    timings.stage("join", 100)
    x, y = maps.camera.plane_coordinates()
    joined = join_depth(np.moveaxis(maps.normal, -1, 0), np.radians(maps.sigma), maps.mask, depth.depth, depth.sigma, measured, x, y,
                        perspective=maps.camera.projection == "perspective", device=device, progress=timings.advance_percent)
    if joined.unexplained is not None and joined.unexplained > CONTRADICTION:
        raise RequestError(f"{maps_file}: its normals leave {joined.unexplained:.0%} of the relief in {depth_file} unexplained: they are "
                           "not of one surface, or the axes of one of them are flipped")
    timings.stage("write", 1)
    result = _maps(maps, joined, {"maps": digest(maps_file), "depth": digest(depth_file)})
    facts = _facts(maps, depth, joined, overlap)
    warnings = _warnings(facts)
    report_path = request.out / REPORT_FILE
    result.write(target)
    write_text(report_path, report(
        request, inputs={"maps": str(maps_file), "depth": str(depth_file), "name": maps.provenance.get("relit:capture", "")},
        device=devices.describe(device), timings_s=timings.close(), **facts, warnings=warnings))
    return JoinResult(target, report_path, facts, tuple(warnings))


def _check_cameras(one: Camera, other: Camera, maps_file: Path, depth_file: Path) -> None:
    """Refuse two cameras that see other pixels, or whose pixels have no length in metres."""
    def numbers(camera: Camera) -> dict[str, Any]:
        pose = None if one.world_from_camera is None or other.world_from_camera is None else camera.world_from_camera
        lens = (0.0,) * 5 if camera.distortion is None else (*camera.distortion.k, *camera.distortion.p)
        return {"projection": camera.projection, "resolution": camera.resolution, "focal_px": camera.focal_px,
                "principal_px": camera.principal_point, "distortion": lens,
                "pixel_size_m": camera.pixel_size_m, "world_from_camera": pose}

    here, there = numbers(one), numbers(other)
    for name, value in here.items():
        same = value == there[name]
        if not same and None not in (value, there[name]) and not isinstance(value, str):
            same = np.allclose(np.asarray(value, dtype=float), np.asarray(there[name], dtype=float), rtol=CAMERA_TOLERANCE, atol=ROUNDING)
        if not same:
            raise RequestError(f"{depth_file}: {name} of its camera is not that of {maps_file}: both must be of one camera in one place")
    if one.projection == "orthographic" and one.pixel_size_m is None:
        raise RequestError(f"{maps_file}: its camera has no pixel_size_m, so that its normals cannot be compared with metres")


def _maps(maps: SurfaceMaps, joined: Joined, contents: dict[str, str]) -> SurfaceMaps:
    """Return the maps with the joined surface; pixels that have no place of their own are unsure."""
    sure = joined.placed & ~joined.guessed & ~joined.rejected
    status = None if maps.status is None else np.where(maps.mask & ~sure, Status.UNSURE, maps.status).astype(np.uint8)
    mean_z = float(joined.height[maps.mask & sure].mean()) if (maps.mask & sure).any() else None
    return replace(maps, mask=maps.mask & sure, estimated=maps.mask, normal=np.moveaxis(joined.normal, 0, -1), height=joined.height,
                   height_sigma=joined.sigma, part=numbered(joined.part) if joined.part.max() > 0 else None, status=status,
                   camera=maps.camera.model_copy(update={"surface_z_m": mean_z}),
                   provenance={**maps.provenance, JOINED: json.dumps(contents, sort_keys=True)})


def _facts(maps: SurfaceMaps, depth: DepthMaps, joined: Joined, overlap: int) -> dict[str, Any]:
    assert maps.normal is not None and depth.sigma is not None
    placed = joined.placed & maps.mask
    turned = degrees_between(np.moveaxis(maps.normal, -1, 0), joined.normal)[placed]
    before = depth.sigma[placed & depth.mask]
    shared = depth.provenance.get(CALIBRATION_SIGMA)
    return {
        **({} if shared is None else {"calibration_sigma_m": float(shared)}),
        "pixels": {"mask": int(maps.mask.sum()), "with_depth": overlap, "placed": int(placed.sum()),
                   "beside_steps": int((joined.guessed & maps.mask).sum()), "rejected_depths": int(joined.rejected.sum()),
                   "solved": int((maps.mask & joined.placed & ~joined.guessed & ~joined.rejected).sum())},
        "sigma_m": {"depth_median": _median(before), "joined_median": _median(joined.sigma[placed])},
        "normals_turned_degrees": {"median": _median(turned), "p95": round(float(np.percentile(turned, 95)), 4) if turned.size else 0.0},
        "parts": int(joined.part.max()) + 1,
        "depth_step_m": float(f"{joined.step_m:.3g}"), "depth_noise_factor": round(joined.noise_factor, 3),
        "depth_shared_error_m": float(f"{joined.shared_m:.3g}"),
        "contradicted_degrees": round(joined.contradicted_degrees, 2), "depth_one_sided_m": float(f"{joined.one_sided_m:.3g}"),
        "normals_factor": round(joined.factor, 4), "depth_shift_px": [round(pixels, 2) for pixels in joined.shift_px],
        "relief_unexplained": None if joined.unexplained is None else round(joined.unexplained, 5),
    }


def _median(values: np.ndarray) -> float:
    return float(f"{np.median(values):.4g}") if values.size else 0.0


def _warnings(facts: dict[str, Any]) -> list[str]:
    pixels, found = facts["pixels"], []
    if (shared := facts.get("calibration_sigma_m", 0.0)) > (own := facts["sigma_m"]["joined_median"]) > 0:
        found.append(f"depth: its calibration leaves {shared:.3g} m open of all depths together, {shared / own:.2g} times height_sigma "
                     "(median), which does not hold what all pixels share")
    if (step := facts["depth_step_m"]) > ROUNDED * (sigma := facts["sigma_m"]["depth_median"]):
        found.append(f"depth: its values lie in steps of {step:.2g} m, {step / sigma:.2g} times sigma.Z: their rounding counts as noise; "
                     "write them with more digits")
    if facts["depth_noise_factor"] > NOISIER:
        found.append(f"depth: its noise is {facts['depth_noise_factor']:.2g} times sigma.Z, and counts as such")
    if facts["depth_shared_error_m"] > SHARED * facts["sigma_m"]["depth_median"]:
        found.append(f"depth: neighbours share errors of {facts['depth_shared_error_m']:.2g} m that no drift of normals makes, as after "
                     "smoothing, by ripple or from another place of the camera: height_sigma holds them")
    if facts["depth_one_sided_m"] > SHARED * facts["sigma_m"]["depth_median"]:
        found.append(f"depth: its errors pull the surface to one side by some {facts['depth_one_sided_m']:.2g} m, as where many depths are "
                     "off alike and too near to be left out: height_sigma holds that")
    if facts["normals_factor"] != 1:
        flat = facts["normals_factor"] > 1
        found.append(f"normals: the relief of the depth is {facts['normals_factor']:.3g} times theirs: they are too "
                     f"{'flat' if flat else 'steep'}, or the depth is too {'deep' if flat else 'shallow'} (its scale or baseline); the "
                     "joined ones have that of the depth, and height_sigma holds both")
    if facts["contradicted_degrees"]:
        found.append(f"depth and normals contradict each other by {facts['contradicted_degrees']:.2g}° in the median, smoothly: either the "
                     "lights of the solve are off, or the depth is bent or tilted (as a range along the ray given as depth along the "
                     "axis); the joined ones follow the depth, and height_sigma holds both")
    if any(facts["depth_shift_px"]):
        right, down = facts["depth_shift_px"]
        found.append(f"depth: it looks shifted by {right:+.2g} px to the right and {down:+.2g} px down against the normals, as where the "
                     "camera moved between both: it was moved back, and height_sigma holds that; take both from one place")
    lost = (pixels["mask"] - pixels["placed"]) / pixels["mask"]
    if lost > MANY:
        found.append(f"height: {lost:.0%} of the surface has too few depths to be placed, and is kept as unsure")
    if pixels["rejected_depths"] > MANY * pixels["with_depth"]:
        found.append(f"depth: {pixels['rejected_depths'] / pixels['with_depth']:.0%} of the depths contradict those around them by more "
                     "than their sigma explains: it may be too small")
    return found

