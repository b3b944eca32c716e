"""Solve a capture: images → normals, reflectance and height, in maps.exr and report.json."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.surface.integrate import Integration
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.solve import MAX_SIGMA, SVBRDF_LIGHTS, Intensities, LightsKnown, Method, SolveRequest
from service.solve import integrability
from service.solve.diagnosis import diagnose, raise_error
from service.solve.distance import Distance, find_distance
from service.solve.intensities import choose_intensities
from service.solve.methods import METHODS, Solver
from service.solve.parts import numbered, place_solution
from service.solve.sharing import SharedSolve
from service.solve.solution import Solution, SolveInput, SuspectLight, mark_not_facing, refine_status
from service.solve.surface import guessed_part, height_warnings, integrate
from stage.brackets import merge_brackets, one_frame_a_light
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.errors import ManifestError
from stage.files import write_text
from stage.ingest import open_stack
from stage.lighting import check_surface, distant_lights
from stage.manifest import FILE_NAME
from stage.maps import MAPS_FILE, SurfaceMaps
from stage.motion.tracking import tracking_frames
from stage.point_lights import DistantLights, PlacedLights, distance_is_missing
from stage.radiance import clipping_sentences
from stage.stack import Stack

if TYPE_CHECKING:
    from service.solve.lights_over_time import LightsOverTime
    from service.solve.polarised import Separated
    from service.solve.refined_lights import RefinedLights
    from service.solve.unknown_lights import UnknownLights


class SolveResult(NamedTuple):
    """What a solve made."""

    maps: SurfaceMaps
    maps_path: Path
    report_path: Path
    counts: dict[str, int]
    """Pixels of the mask by the name of their status."""
    suspects: tuple[SuspectLight, ...]
    """Distant lights that disagree with the others."""
    warnings: tuple[str, ...]
    """A sentence for each thing that does not fit on the whole object."""


class _Opened(NamedTuple):
    """A capture that is ready to be solved."""

    capture: Capture
    method: Method
    lights: Any
    """With the intensities that the solve uses."""
    declared: Any
    """As the manifest has them."""
    solver: Solver
    given: SolveInput
    facts: dict[str, Any]
    """What the report says of the lights."""
    found: "UnknownLights | RefinedLights | None" = None
    """How the lights were found, where they are those of the images."""
    distance: Distance | None = None
    """How the distance of the surface was found, where the manifest does not say it."""


def solve(request: SolveRequest, progress: Progress | None = None, *, capture: Capture | None = None,
          sharing: SharedSolve | None = None, over_time: "LightsOverTime | None" = None) -> SolveResult:
    """Solve a capture, and write its maps and a report.

    Args:
        request: the capture, the method and the folder of the results.
        progress: told how far the work is.
        capture: that of the request, opened with its pixels; None: it is opened here.
        sharing: the part of this process where several share the solve; the others call `help_solve`.
        over_time: what the captures of a sequence share; None: the capture is no step of one.

    Raises:
        StageError, KernelError: the input is wrong; nothing is written.
        StorageError: the results cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    capture, method, lights, declared, solver, given, facts, found, distance = _open(request, capture, timings, sharing, over_time)
    stack, mask = given.stack, given.mask
    solution = solver(given, lights)
    solution.facts = facts | solution.facts
    mark_not_facing(capture.camera, solution)
    if given.pairs is not None:
        _say_of_pairs(given, method, solution)
    timings.stage("diagnosis", 1)
    diagnose(given, capture, lights, declared, solution)
    if found is not None:
        solution.warnings += found.warnings
        raise_error(solution, found.doubt(solution.normal))
    if distance is not None:
        solution.facts |= distance.facts
        solution.warnings.append(distance.warning)
        raise_error(solution, distance.normal_degrees)
    estimated = np.isin(solution.status, ESTIMATED).reshape(mask.shape)
    sigma = solution.standard_error() if solution.sigma is None else solution.sigma  # as half: an image has tens of millions of pixels
    if solution.integration is None:  # near lights have found the height with the normals
        solution.integration = integrate(given, solution.normal, estimated, sigma=sigma)
        solution.height = None if solution.integration is None else solution.integration.height.numpy()
    placed = place_solution(given, lights, solution) if isinstance(lights, DistantLights) else None
    if placed is not None:
        solution.height = placed.height
        solution.warnings += placed.warnings()
    if solution.judged_by_surface and solution.height is not None:
        normal = np.moveaxis(solution.normal.reshape(3, *mask.shape), 0, -1)
        factor = integrability.doubt(sigma.astype(np.float32).reshape(mask.shape), normal, solution.height, estimated, capture.camera)
        solution.confidence = (solution.confidence * factor.reshape(-1)).astype(np.float16)
    refine_status(solution, stack, max_sigma=MAX_SIGMA if request.max_sigma is None else request.max_sigma,
                  least_confidence=request.least_confidence or 0.0)
    status = solution.status.reshape(mask.shape)
    solved = np.isin(status, SOLVED)
    counts = {s.name.lower(): int(np.count_nonzero(status[mask] == s)) for s in Status}
    if not solved.any():
        solution.warnings.append(_nothing_solved(counts))
    guessed = guessed_part(sigma, estimated)
    solution.warnings += height_warnings(guessed, method)
    solution.warnings += [*capture.doubts, *clipping_sentences(capture.clipped)]
    sources = metadata(request, method=method, capture=capture.name, inputs=stack.key, contents=solution.contents)
    maps = _maps(solution, solved, estimated, method, capture, sources)
    timings.stage("write", 1)
    maps_path, report_path = request.out / MAPS_FILE, request.out / REPORT_FILE
    maps.write(maps_path)
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
        albedo_above_one=int((maps.diffuse_albedo[solved] > 1).any(axis=-1).sum()) if maps.diffuse_albedo is not None else 0,
        height=_height_report(solution.integration, guessed, capture),
        **({} if placed is None else {"parts": [part.facts() for part in placed.parts]}),
        **({} if stack.motion is None else {"motion": stack.motion}),
    ))
    return SolveResult(maps, maps_path, report_path, counts, tuple(solution.suspects), tuple(solution.warnings))


def help_solve(request: SolveRequest, progress: Progress, sharing: SharedSolve, *, over_time: "LightsOverTime | None" = None) -> None:
    """Do pieces of a solve that another process has begun; nothing is written but what it reads of them.

    Args:
        request: that of the other process, on a device of the same kind.
        progress: told how far the solve is; it ends the help by an exception.
        sharing: the part of this process.
        over_time: as for solve.

    Raises:
        StageError, KernelError: the input is wrong.
        DivergedError: this process finds something else than the other.
    """
    opened = _open(request, None, Timings(progress), sharing, over_time)
    opened.solver(opened.given, opened.lights)


def _open(request: SolveRequest, capture: Capture | None, timings: Timings, sharing: SharedSolve | None,
          over_time: "LightsOverTime | None" = None) -> _Opened:
    """Open the capture of a request, if it is not open, and read its images into a stack."""
    chosen = devices.resolve_all(request.device)
    timings.stage("open", 1)
    capture = capture or Capture.open(request.capture, request.pixels)
    unknown = request.lights is LightsKnown.UNKNOWN
    method = request.method or (_method_of_unknown(capture) if unknown else
                                next(method for method, entry in METHODS.items() if entry.is_default(capture)))
    if (method is Method.REFERENCE) != (request.reference_ball is not None):
        raise RequestError("--method reference and --reference-ball CAPTURE go together: give both or neither")
    if unknown and DistantLights not in METHODS[method].solvers:
        raise RequestError(f"--lights unknown: --method {method} is not for distant lights: take svbrdf, robust or lambert")
    balls = [] if request.reference_ball is None else [Capture.open(request.reference_ball, request.pixels._replace(crop=None))]
    if unknown:
        _check_known(capture)
        check_surface(capture)
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    distance = None
    alone = over_time is None and not capture.is_polarised  # steps would find distances of their own; pairs are no lights of their own
    if alone and not unknown and method in (Method.LAMBERT, Method.ROBUST, Method.SVBRDF) and distance_is_missing(capture):
        timings.stage("distance", len(capture.sources()))
        distance = find_distance(capture, open_stack(capture, cache=request.cache, tracking=tracking,
                                                     progress=lambda done, _: timings.advance(done)), chosen[0])
        capture = distance.capture
    lights = distant_lights(capture) if unknown else METHODS[method].read_lights(capture, *balls)
    solver = METHODS[method].solvers.get(type(lights))
    if solver is None:  # only extended lights can be missing here: every method takes distant and near ones
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light: some are extended: --method svbrdf solves these, "
                            f"{method} needs lights of one direction each")
    mask = capture.mask()
    pairs = None
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done))
    if isinstance(lights, DistantLights | PlacedLights) and not unknown:  # placeholders say nothing of which frames have one light
        if capture.is_polarised:
            stack, lights, pairs = _separated(stack, capture, lights, mask)
        else:
            stack, lights = one_frame_a_light(merge_brackets(stack, capture.sources(), lights), lights)
    if sharing is not None:
        sharing.identify(chosen[0], str(method), stack.key, mask, stack.scale, capture.manifest.model_dump_json())
    given = SolveInput(stack, capture.camera, mask, chosen, timings, request.cache, sharing=sharing,
                       relative=unknown or capture.manifest.irradiance_scale == "relative",
                       refine_intensities=request.intensities is Intensities.CHOSEN, pairs=pairs)
    if request.lights is not LightsKnown.DECLARED:
        timings.stage("lights", 1)
        found = _find_lights(request.lights, given, lights, capture)
        return _Opened(capture, method, found.lights, found.lights, solver, given, found.facts, found, distance)
    used: Any = lights
    facts: dict[str, Any] = {}
    if isinstance(lights, DistantLights) and given.refine_intensities:
        timings.stage("intensities", 1)
        used, facts = choose_intensities(given, lights) if over_time is None else over_time.choose(given, lights)
    return _Opened(capture, method, used, lights, solver, given, facts, distance=distance)


def _check_known(capture: Capture) -> None:
    """Refuse polarised pairs whose lights are to be found from the images."""
    if capture.is_polarised:
        raise RequestError(f"--lights unknown: {capture.folder} has polarised pairs: their lights must be known, because a pair is the "
                           "images of one light")


def _separated(stack: Stack, capture: Capture, lights: DistantLights | PlacedLights, mask: np.ndarray) -> "Separated":
    from service.solve.polarised import separate_pairs

    return separate_pairs(stack, capture, lights, mask)


def _say_of_pairs(given: SolveInput, method: Method, solution: Solution) -> None:
    """Add what was found about polarised pairs, and doubt metals where the method does not look at highlights."""
    assert given.pairs is not None
    solution.warnings += given.pairs.warnings
    if method is not Method.SVBRDF:
        from service.solve.polarised import doubt_metals

        doubt_metals(given, solution)


def _find_lights(known: LightsKnown, given: SolveInput, lights: Any, capture: Capture) -> "UnknownLights | RefinedLights":
    """Return the lights that the images ask for; their kernels and methods are imported for captures that need them."""
    if known is LightsKnown.UNKNOWN:
        from service.solve.unknown_lights import find_lights

        return find_lights(given)
    if not isinstance(lights, DistantLights):
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light: --lights refined is for distant lights alone")
    from service.solve.refined_lights import refine_lights

    return refine_lights(given, lights)


def _method_of_unknown(capture: Capture) -> Method:
    return Method.SVBRDF if len(capture.sources()) >= SVBRDF_LIGHTS else Method.ROBUST


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


def _nothing_solved(counts: Mapping[str, int]) -> str:
    """Return the sentence for a result without a solved pixel."""
    common = max(counts, key=lambda name: counts[name])
    share = 100 * counts[common] / max(sum(counts.values()), 1)
    keep = ("; --max-sigma 180 keeps unsure normals" if common == Status.UNSURE.name.lower() else
            "; check the lights, the exposure and the mask")
    return f"no pixel is solved: {share:.0f} % of the mask have the status {common}, and the layer status says why for every pixel{keep}"


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
