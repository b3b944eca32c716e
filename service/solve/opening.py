"""Open a capture for a solve: its method, its lights, and its images as a stack."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from kernels import device as devices
from service.errors import RequestError
from service.light_estimation.dark_lights import dark_frames, dark_sentence
from service.reporting.progress import Timings
from service.requests.solve import SVBRDF_LIGHTS, Intensities, LightsKnown, Method, SolveRequest
from service.sharing.sharing import SharedSolve
from service.solve.albedo_scale import check_request, moderate
from service.solve.base.solution import Solution, SolveInput
from service.solve.height.distance import Distance, find_distance
from service.solve.lights.intensities import LightsOverTime, choose_intensities
from service.solve.lights.other_lights import OtherLights, Rig, find_other_lights
from service.solve.methods.methods import METHODS, Solver, solve_in_rig
from service.solve.unlit import unlit
from stage.capture.capture import Capture
from stage.capture.lighting import check_surface, distant_lights
from stage.capture.manifest import FILE_NAME
from stage.capture.point_lights import DistantLights, PlacedLights, distance_is_missing
from stage.errors import ManifestError
from stage.motion.tracking import tracking_frames
from stage.stack.brackets import chosen_frames, merge_brackets, one_frame_a_light
from stage.stack.ingest import Ingest, open_stack
from stage.stack.peaks import Peaks
from stage.stack.readings import said_by_readings
from stage.stack.stack import Stack

if TYPE_CHECKING:
    from service.solve.lights.placement import RefinedPlaces
    from service.solve.lights.refined_lights import RefinedLights
    from service.solve.lights.unknown_lights import UnknownLights

Lights = TypeVar("Lights", bound=DistantLights | PlacedLights)


class Opened(NamedTuple):
    """A capture that is ready to be solved."""

    capture: Capture
    method: Method
    lights: Any
    """The lights with the intensities that the solve uses."""
    declared: Any
    """The lights as the manifest has them."""
    solver: Solver
    given: SolveInput
    unlit: np.ndarray
    """[rows, cols] bool, pixels of the capture's mask that no lamp lights, which are not solved."""
    facts: dict[str, Any]
    """Facts about the lights for the report."""
    found: "UnknownLights | RefinedLights | RefinedPlaces | None" = None
    """The way in which the lights were found, where they are those of the images."""
    brighter: float = 1.0
    """The factor by which the lights of the solve are brighter than those of the manifest, whose common factor is not known."""
    distance: Distance | None = None
    """The way in which the distance of the surface was found, where the manifest does not say it."""
    other: OtherLights | None = None
    """Lights that explain the images much better than distant ones of the manifest."""
    rig: Rig | None = None
    """Where the solve takes distant lights to be; None: at infinity."""

    def solve(self) -> Solution:
        """Solve the capture."""
        return self.solver(self.given, self.lights) if self.rig is None else solve_in_rig(self.given, self.rig.lights, self.method)


def open_solve(request: SolveRequest, capture: Capture | None, timings: Timings, sharing: SharedSolve | None,
               over_time: LightsOverTime | None = None) -> Opened:
    """Open the capture of a request, unless it is given with its pixels, and read its images into a stack."""
    chosen = devices.resolve_all(request.device)
    timings.stage("open", 1)
    capture = capture or Capture.open(request.capture, request.pixels)
    unknown = request.lights is LightsKnown.UNKNOWN
    method = request.method or _default_method(capture, unknown=unknown)
    if (method is Method.REFERENCE) != (request.reference_ball is not None):
        raise RequestError("--method reference and --reference-ball CAPTURE go together: give both or neither")
    if unknown and DistantLights not in METHODS[method].solvers:
        raise RequestError(f"--lights unknown: --method {method} is not for distant lights: take svbrdf, robust or lambert")
    balls = [] if request.reference_ball is None else [Capture.open(request.reference_ball, request.pixels._replace(crop=None))]
    if unknown:
        if capture.is_polarised:
            raise RequestError(f"--lights unknown: {capture.folder} has polarised pairs: their lights must be known, because a pair is the "
                               "images of one light")
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
    timings.stage("files", 100)
    ingest = Ingest.of(capture, cache=request.cache, tracking=tracking, progress=timings.advance_percent)
    timings.stage("ingest", len(capture.sources()))
    stack = ingest.stack(lambda done, _: timings.advance(done))
    if over_time is None:
        (peaks := Peaks(capture, mask)).recall(stack.peaks)
        capture = replace(capture, doubts=(*capture.doubts, *said_by_readings(capture, peaks)))
    if isinstance(lights, DistantLights | PlacedLights) and not unknown:  # placeholders say nothing of which frames have one light
        if capture.is_polarised:
            from service.solve.methods.polarised import separate_pairs

            stack, lights, pairs = separate_pairs(stack, capture, lights, mask)
        else:
            stack, lights = one_frame_a_light(merge_brackets(stack, capture.sources(), lights), lights)
            if over_time is None:  # steps share the lights of the first
                capture, stack, lights = _without_dark_frames(capture, stack, lights, mask)
    dark = unlit(stack if pairs is None else pairs.whole, mask, timings)
    mask = mask & ~dark
    if not mask.any():
        raise ManifestError(f"{capture.folder / FILE_NAME}: mask: no light reaches its pixels, whose readings are noise alone: it lies on "
                            "the black background")
    if sharing is not None:
        sharing.identify(chosen[0], str(method), stack.key, mask, stack.scale, capture.manifest.model_dump_json())
    given = SolveInput(stack, capture.camera, mask, chosen, timings, request.cache, sharing=sharing,
                       relative=unknown or capture.manifest.irradiance_scale == "relative",
                       refine_intensities=request.intensities is Intensities.CHOSEN, pairs=pairs)
    check_request(request, capture, relative=given.relative)
    brighter = 1.0
    if isinstance(lights, DistantLights | PlacedLights) and not unknown:
        lights, brighter = moderate(given, lights, capture)
    if request.lights is not LightsKnown.DECLARED:
        timings.stage("lights", 1)
        found = _find_lights(request.lights, given, lights, capture)
        return Opened(capture, method, found.lights, found.lights, solver, given, dark, found.facts, found, brighter, distance)
    used: Any = lights
    facts: dict[str, Any] = {}
    if isinstance(lights, DistantLights) and given.refine_intensities:
        timings.stage("intensities", 1)
        used, facts = choose_intensities(given, lights) if over_time is None else over_time.choose(given, lights)
    other = find_other_lights(given, used) if isinstance(used, DistantLights) else None
    rig = other.rig if other is not None and over_time is None and pairs is None else None  # steps would find rigs of their own
    return Opened(capture, method, used, lights, solver, given, dark, facts if rig is None else facts | rig.facts(), brighter=brighter,
                  distance=distance, other=other, rig=rig)


def _without_dark_frames(capture: Capture, stack: Stack, lights: Lights, mask: np.ndarray) -> tuple[Capture, Stack, Lights]:
    """Leave out the frames whose lamp did not burn; the capture has a doubt about them."""
    dark = dark_frames(stack, lights, mask)
    if not dark.any():
        return capture, stack, lights
    doubt = dark_sentence(stack.frames, dark, "left out")
    return replace(capture, doubts=(*capture.doubts, doubt)), *chosen_frames(stack, lights, ~dark)


def _default_method(capture: Capture, *, unknown: bool) -> Method:
    if unknown:
        return Method.SVBRDF if len(capture.sources()) >= SVBRDF_LIGHTS else Method.ROBUST
    return next(method for method, entry in METHODS.items() if entry.is_default(capture))


def _find_lights(known: LightsKnown, given: SolveInput, lights: Any,
                 capture: Capture) -> "UnknownLights | RefinedLights | RefinedPlaces":
    """Return the lights that the images ask for; their kernels and methods are imported for captures that need them."""
    if known is LightsKnown.UNKNOWN:
        from service.solve.lights.unknown_lights import find_lights

        return find_lights(given)
    if isinstance(lights, PlacedLights):
        from service.solve.lights.placement import refine_places

        return refine_places(given, lights)
    if not isinstance(lights, DistantLights):
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light: --lights refined is for distant and near lights alone")
    from service.solve.lights.refined_lights import refine_lights

    return refine_lights(given, lights)
