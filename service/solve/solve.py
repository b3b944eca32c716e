"""Solve a capture: images → normals, reflectance and height, in maps.exr and report.json."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.surface.integrate import Integration
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import HASHING, LIGHTS, REPORT_FILE, hash_of_lights, metadata, report
from service.requests.solve import MAX_SIGMA, Materials, Method, SolveRequest
from service.sharing.sharing import SharedSolve
from service.solve.albedo_scale import scale_albedo
from service.solve.base.solution import Solution, SolveInput, SuspectLight, doubtful_normals, mark_not_facing, raise_error, refine_status
from service.solve.coherent_materials import agree_on_materials
from service.solve.height import integrability
from service.solve.height.height import guessed_part, height_warnings, integrate
from service.solve.height.parts import Placement, numbered, place_solution
from service.solve.inside_pixels import unseen_bend
from service.solve.lights.diagnosis import diagnose
from service.solve.lights.intensities import LightsOverTime
from service.solve.methods.methods import METHODS
from service.solve.opening import Opened, open_solve
from service.solve.sliding import Slide, find_slide
from service.solve.steadiness import Drift, Shake, find_motion
from service.solve.translucency import Translucency, find_translucency
from service.solve.veil import Veil, find_veil
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.point_lights import DistantLights
from stage.colour.colour_spaces import linear_space
from stage.colour.radiance import clipping_sentences
from stage.files import write_text
from stage.results.maps import ALBEDO_SCALE, MAPS_FILE, SurfaceMaps
from stage.stack.ingest import LAYOUT

MANY_ABOVE_ONE = 0.01
"""Part of the solved pixels with an albedo above 1 from which it is said: noise and highlights reach that at less."""
SURELY_ABOVE = 2.0
"""Standard errors of the albedo: metal whose normals are hardly known has any albedo."""


class SolveResult(NamedTuple):
    """The files and findings of a solve."""

    maps: SurfaceMaps
    maps_path: Path
    report_path: Path
    counts: dict[str, int]
    """Pixels of the mask by the name of their status."""
    suspects: tuple[SuspectLight, ...]
    """Distant lights that disagree with the others."""
    warnings: tuple[str, ...]
    """A sentence for each thing that does not fit on the whole object."""


def solve(request: SolveRequest, progress: Progress | None = None, *, capture: Capture | None = None,
          sharing: SharedSolve | None = None, over_time: LightsOverTime | None = None) -> SolveResult:
    """Solve a capture, and write its maps and a report.

    Args:
        capture: that of the request, opened with its pixels; None: it is opened here.
        sharing: the part of this process where several share the solve; the others call `help_solve`.
        over_time: what the captures of a sequence share; None: the capture is no step of one.

    Raises:
        StageError, KernelError: the input is wrong; nothing is written.
        StorageError: the results cannot be written; nothing is left half-written.
    """
    opened = open_solve(request, capture, Timings(progress), sharing, over_time)
    judged = _judge(request, opened, opened.solve())
    scale = scale_albedo(judged.solution, request, opened.brighter, over_time) if opened.given.relative else 1.0
    return _write(request, opened, judged, scale)


def help_solve(request: SolveRequest, progress: Progress, sharing: SharedSolve, *, over_time: LightsOverTime | None = None) -> None:
    """Do pieces of a solve that another process has begun; nothing is written but what it reads of them.
    `request`: that of the other process, on a device of the same kind. `progress`: told how far the solve is; it ends the help by an
    exception. Raises DivergedError: this process finds something else than the other."""
    opened = open_solve(request, None, Timings(progress), sharing, over_time)
    opened.solve()


class _Judged(NamedTuple):
    solution: Solution
    placement: Placement | None
    """Parts of the object in depth; None: the height has no break, or shadows were not looked at."""
    estimated: np.ndarray  # [rows, cols] bool, pixels with values
    guessed: float
    """Part of the surface whose height rests on normals that are hardly known."""


def _spoilt(given: SolveInput, lights: DistantLights, solution: Solution,
            moved: bool) -> Iterator[Slide | Shake | Drift | Translucency | Veil]:
    """Yield what spoils the images beside the lights; whether frames are moved with texture is asked where it may tell."""
    slide = find_slide(given, lights, solution)
    if slide is not None:  # which blurs edges, too
        yield slide
        return
    if moved:
        yield from find_motion(given, lights, solution)
    for find in (find_translucency, find_veil):
        found = find(given, lights, solution)
        if found is not None:
            yield found


def _judge(request: SolveRequest, opened: Opened, solution: Solution) -> _Judged:
    """Find the height of a solution, how sure it is, and what does not fit; the solution is changed."""
    given, shape = opened.given, opened.given.mask.shape
    solution.facts = opened.facts | solution.facts
    solution.status[opened.unlit.reshape(-1)] = Status.DARK
    mark_not_facing(opened.capture.camera, solution)
    if given.pairs is not None:
        _say_of_pairs(given, opened.method, solution)
    given.timings.stage("diagnosis", 1)
    said = len(solution.warnings)
    diagnose(given, opened.capture, opened.lights, opened.declared, solution, opened.other, opened.rig)
    if isinstance(opened.lights, DistantLights) and opened.rig is None:
        # highlights bend what least squares makes of texture, and lights that are wrong move everything
        moved = opened.method is not Method.LAMBERT and len(solution.warnings) == said
        for found in _spoilt(given, opened.lights, solution, moved):
            solution.warnings.append(found.sentence)
            raise_error(solution, found.degrees)
    if "left_out_misfit" in solution.facts:
        from service.solve.methods.support import raise_undescribed

        raise_undescribed(solution)
    if opened.found is not None:
        solution.warnings += opened.found.warnings
        raise_error(solution, opened.found.doubt(solution.normal))
    if opened.distance is not None:
        solution.facts |= opened.distance.facts
        solution.warnings.append(opened.distance.warning)
        raise_error(solution, opened.distance.normal_degrees)
    estimated = np.isin(solution.status, ESTIMATED).reshape(shape)
    sigma, specular = solution.sigma, solution.whole_metals()  # as half: an image has tens of millions of pixels
    if solution.integration is None:  # near lights have found the height with the normals
        solution.integration = integrate(given, solution.normal, estimated, sigma=sigma, specular=specular)
        solution.height = None if solution.integration is None else to_numpy(solution.integration.height)
    placement = None
    if isinstance(opened.lights, DistantLights):
        shown = given.whole if opened.method is Method.SVBRDF else given  # what the materials of the solution reflect
        placement = place_solution(shown, opened.lights, solution, partial(
            integrate, given, solution.normal, estimated, sigma=sigma, specular=specular))
    if solution.shared_misfit is not None and solution.height is not None:
        _judge_by_surface(solution, estimated, opened.capture.camera)
    raise_error(solution, unseen_bend(solution.normal.reshape(3, *shape), solution.standard_error().reshape(shape), estimated).reshape(-1))
    if request.materials is Materials.COHERENT:
        agree_on_materials(solution, sigma, shape, given.device, given.timings)
    refine_status(solution, given.stack, max_sigma=MAX_SIGMA if request.max_sigma is None else request.max_sigma,
                  least_confidence=request.least_confidence or 0.0)
    return _Judged(solution, placement, estimated, guessed_part(sigma, estimated))


def _write(request: SolveRequest, opened: Opened, judged: _Judged, albedo_scale: float) -> SolveResult:
    capture, method, given, solution = opened.capture, opened.method, opened.given, judged.solution
    stack, mask, timings = given.stack, given.mask | opened.unlit, given.timings
    status = solution.status.reshape(mask.shape)
    solved = np.isin(status, SOLVED)
    counts = {s.name.lower(): int(np.count_nonzero(status[mask] == s)) for s in Status}
    above = _count_above_one(solution, solved)
    if above > MANY_ABOVE_ONE * solved.sum() and method is not Method.REFERENCE:
        solution.warnings.append(_above_one(above / solved.sum(), capture, shining=solution.specular is None))
    if not solved.any():
        solution.warnings.append(_nothing_solved(counts, request.least_confidence))
    elif (doubtful := doubtful_normals(status)) is not None:
        solution.warnings.append(doubtful)
    solution.warnings += height_warnings(judged.guessed, method, given.mask)
    outdated = devices.outdated_driver() if request.device is None else None
    solution.warnings += [outdated] if outdated else []
    solution.warnings += [*capture.doubts, *clipping_sentences(capture.clipped)]
    sources = metadata(request, method=method, capture=capture.name, inputs=stack.key, contents=solution.contents)
    sources |= {HASHING: str(LAYOUT), LIGHTS: hash_of_lights(capture.manifest)}
    sources |= {ALBEDO_SCALE: f"{albedo_scale:g}"} if albedo_scale != 1 else {}
    maps = _maps(solution, solved, judged.estimated, method, capture, sources)
    timings.stage("write", len(mask))
    maps_path, report_path = request.out / MAPS_FILE, request.out / REPORT_FILE
    maps.write(maps_path, timings.advance)
    write_text(report_path, report(
        request,
        inputs={"capture": str(request.capture), "name": capture.name, "content": stack.key, "frames": len(capture.sources()),
                "resolution": list(capture.camera.resolution), "color_space": capture.manifest.color_space,
                "irradiance_scale": capture.manifest.irradiance_scale},
        method=str(method),
        found=solution.facts,
        warnings=solution.warnings,
        suspect_lights=[suspect._asdict() for suspect in solution.suspects],
        device="; ".join(map(devices.describe, given.devices)),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        residual={**_residual_statistics(solution.residual.reshape(mask.shape)[solved]), "meaning": METHODS[method].residual},
        albedo_above_one=above,
        height=_height_report(solution.integration, judged.guessed, capture),
        **({} if judged.placement is None else {"parts": [part.facts() for part in judged.placement.parts]}),
        **({} if stack.motion is None else {"motion": stack.motion}),
    ))
    return SolveResult(maps, maps_path, report_path, counts, tuple(solution.suspects), tuple(solution.warnings))


def _judge_by_surface(solution: Solution, estimated: np.ndarray, camera: Camera) -> None:
    """Raise σ to what the surface shows of errors: of noise the fit says as much, of errors that neighbours share less."""
    assert solution.shared_misfit is not None and solution.height is not None
    shape, found = estimated.shape, _part_numbers(solution)
    part = np.where(estimated, 1 if found is None else found, 0)
    normal = np.moveaxis(solution.normal.reshape(3, *shape), 0, -1)
    shown = np.maximum(solution.standard_error().reshape(shape),
                       integrability.doubt(normal, solution.height, part, camera, shared=solution.shared_misfit))
    sigma = integrability.beside_parts(shown, part).reshape(-1)
    solution.sigma = np.where(np.isin(solution.status, ESTIMATED), sigma, solution.sigma).astype(np.float16)


def _say_of_pairs(given: SolveInput, method: Method, solution: Solution) -> None:
    """Add what was found about polarised pairs, and doubt metals where the method does not look at highlights."""
    assert given.pairs is not None
    solution.warnings += given.pairs.warnings
    if method is not Method.SVBRDF:
        from service.solve.methods.polarised import doubt_metals

        doubt_metals(given, solution)


def _maps(solution: Solution, solved: np.ndarray, estimated: np.ndarray, method: Method, capture: Capture,
          provenance: dict[str, str]) -> SurfaceMaps:
    """Return a solution as images; what the method does not estimate is absent."""
    def image(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        return values.reshape(solved.shape) if values.ndim == 1 else np.moveaxis(values.reshape(-1, *solved.shape), 0, -1)

    return SurfaceMaps(
        camera=capture.camera,
        mask=solved,
        estimated=estimated,
        normal=image(solution.normal),
        diffuse_albedo=None if method is Method.REFERENCE else image(solution.albedo),
        diffuse_albedo_sigma=image(solution.albedo_sigma()),
        specular=image(solution.specular),
        roughness=image(solution.roughness),
        **_lobes_of_mixtures(solution, image),
        regime=image(solution.regime),
        specular_normal=image(solution.specular_normal),
        height=solution.height,
        part=_part_numbers(solution),
        sigma=image(solution.standard_error()),
        confidence=image(solution.confidence),
        status=image(solution.status),
        color_space=linear_space(capture.manifest.color_space),
        provenance=provenance,
    )


def _part_numbers(solution: Solution) -> np.ndarray | None:
    """Return the number of the part of each pixel, [rows, cols] uint8, or None where the height has no break."""
    part = None if solution.integration is None else solution.integration.part
    return numbered(part) if part is not None and part.max() > 0 else None


def _lobes_of_mixtures(solution: Solution, image: Callable[[np.ndarray], np.ndarray | None]) -> dict[str, np.ndarray | None]:
    """Return the layers of pixels that mix two materials; none if there is no such pixel."""
    if solution.abundance is None or solution.pair is None or solution.pairs is None:
        return {}
    mixed = solution.abundance > 0
    layers = {"abundance": image(solution.abundance)}
    for place, name in enumerate(("first", "second")):
        lobe = np.where(mixed, solution.pairs[solution.pair, place].T, 0).astype(np.float16)
        layers |= {f"{name}_specular": image(lobe[:3]), f"{name}_roughness": image(lobe[3])}
    return layers


def _nothing_solved(counts: Mapping[str, int], least_confidence: float | None) -> str:
    common = max(counts, key=lambda name: counts[name])
    share = 100 * counts[common] / max(sum(counts.values()), 1)
    alone = " without --least-confidence" if least_confidence else ""
    keep = (f"; --max-sigma 180{alone} keeps unsure normals" if common == Status.UNSURE.name.lower() else
            "; check the lights, the exposure and the mask")
    return f"no pixel is solved: {share:.0f} % of the mask have the status {common}, and the layer status says why for every pixel{keep}"


def _count_above_one(solution: Solution, solved: np.ndarray) -> int:
    """Return the number of solved pixels whose albedo is above 1 by more than SURELY_ABOVE of its standard errors."""
    pixels = np.flatnonzero(solved.reshape(-1) & (solution.albedo > 1).any(axis=0))
    least, sigma = solution.albedo[:, pixels], solution.albedo_sigma(pixels)
    if sigma is not None:
        least = least - np.float32(SURELY_ABOVE) * sigma
    return int((least > 1).any(axis=0).sum())


def _above_one(part: float, capture: Capture, *, shining: bool) -> str:
    """Return the sentence of an albedo above 1 on this part of the pixels; `shining`: whether the method takes highlights for albedo."""
    relative = capture.manifest.irradiance_scale == "relative"
    return (f"diffuse_albedo: is above 1 at {100 * part:.0f} % of the solved pixels, which no texture holds: " + (
        "leave --albedo-scale out, or give a smaller one" if relative else
        ("metal or highlights count as matt there (--method svbrdf tells them), or " if shining else "") +
        "frames[].light are too weak by a factor; declare irradiance_scale relative if it is not known"))


def _residual_statistics(residual: np.ndarray) -> dict[str, float]:
    """Return the median and the 95th percentile of the residuals of the solved pixels, as the method defines them."""
    if residual.size == 0:
        return {}
    values = np.percentile(residual.astype(np.float32), [50, 95])
    return {"median": round(float(values[0]), 5), "p95": round(float(values[1]), 5)}


def _height_report(integration: Integration | None, guessed: float, capture: Capture) -> dict[str, Any]:
    if integration is None:
        return {}
    return {"unit": "m" if capture.camera.metric else "pixel", "iterations": integration.iterations,
            "relative_residual": float(integration.residual), "converged": bool(integration.converged),
            "guessed_part": round(guessed, 4)}
