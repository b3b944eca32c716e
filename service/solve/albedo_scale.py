"""The scale of the albedo of captures whose lights lack a common factor: a choice, which the maps record.

The albedo of such a capture is known up to that factor. Under the lights of the manifest it may lie above 1, which no texture holds, or,
where a rig has large units, below what half floats hold. In the maps it has the scale that the light between its surfaces tells, where that
is decided (service.solve.methods.shadow_light); else its bright pixels have the albedo of a usual bright surface.
"""

import numpy as np

from kernels.photometric.model.samples import some_of
from kernels.status import ESTIMATED
from service.errors import RequestError
from service.light_estimation.explanations import grey_readings
from service.requests.solve import ALBEDO_PERCENTILE, BRIGHT_ALBEDO, SolveRequest
from service.solve.base.solution import Solution, SolveInput, half
from service.solve.lights.intensities import LightsOverTime
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.errors import ManifestError

PIXELS = 400
"""Pixels, spread over the object, that tell the magnitude of its albedo."""
MAGNITUDES = 1e-4, 1e4
"""Least and largest albedo of the object's bright pixels that half floats hold with room for dark pixels, to two digits."""
MOST_REFLECTED = 1.0
"""Most light that a surface returns: the sum of its diffuse albedo and F0."""


def check_request(request: SolveRequest, capture: Capture, *, relative: bool) -> None:
    """Refuse a scale for a capture whose lights are absolute."""
    if request.albedo_scale is not None and not relative:
        raise RequestError(f"--albedo-scale {request.albedo_scale:g}: the lights of {capture.folder / FILE_NAME} are absolute, and "
                           "the albedo with them: declare irradiance_scale relative if they lack a factor")


def moderate(given: SolveInput, lights: DistantLights | PlacedLights, capture: Capture) -> tuple[DistantLights | PlacedLights, float]:
    """Return lights under which half floats hold the albedo, and the factor by which these are brighter than those of the manifest.
    Raises ManifestError: the lights are absolute, and half floats do not hold the albedo."""
    radiance, usable = given.stack.pick_radiance(some_of(given.mask, PIXELS))
    readings = np.where(usable, grey_readings(radiance, lights.irradiance), 0).max(axis=0)
    magnitude = np.pi * float(np.median(readings[readings > 0])) if (readings > 0).any() else 1.0
    if MAGNITUDES[0] <= magnitude <= MAGNITUDES[1]:
        return lights, 1.0
    if not given.relative:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light: under these lights the albedo is about {magnitude:.1e}, "
                            "which no surface has: check the unit of irradiance and intensity, or declare irradiance_scale relative")
    factor = magnitude / BRIGHT_ALBEDO
    irradiance = lights.irradiance * factor
    if isinstance(lights, PlacedLights):
        return lights._replace(irradiance=irradiance, strength=lights.strength * factor), factor
    return lights._replace(irradiance=irradiance), factor


def scale_albedo(solution: Solution, request: SolveRequest, brighter: float, over_time: LightsOverTime | None) -> float:
    """Scale albedo and F0 of a capture of relative lights, and record the factor in the facts of the solution.

    Args:
        brighter: the factor by which the lights of the solve are brighter than those of the manifest.
        over_time: what the steps of a sequence share; None: the capture is no step of one.

    Returns:
        The factor between the albedo of the maps and that under the lights of the manifest.
    """
    chosen = request.albedo_scale
    settled = solution.facts.get("albedo_scale", {})  # by the light that the object throws on itself
    if chosen is None:
        chosen = (settled["value"] if settled.get("decided") else _usual(solution)) / brighter
    if over_time is not None and request.albedo_scale is None:
        chosen = over_time.share_albedo_scale(chosen)
    factor = np.float32(chosen * brighter)
    solution.albedo = half(solution.albedo * factor)
    for name in ("albedo_own", "albedo_tilt"):
        values = getattr(solution, name)
        if values is not None:
            setattr(solution, name, half(values * factor))
    # no surface reflects more than all light, though single pixels seemed brighter than the others say
    if solution.specular is not None:
        solution.specular = np.minimum(solution.specular * factor, 1).astype(np.float16)
    if solution.pairs is not None:
        solution.pairs = solution.pairs.copy()
        solution.pairs[..., :3] = np.minimum(solution.pairs[..., :3] * factor, 1)
    solution.facts["albedo_factor"] = float(f"{chosen:.6g}")
    return float(solution.facts["albedo_factor"])


def _usual(solution: Solution) -> float:
    """Return the factor after which bright pixels have the albedo of a usual bright surface, and return no more light than arrives."""
    known = np.isin(solution.status, ESTIMATED)
    albedo = solution.albedo[:, known].astype(np.float32).max(axis=0, initial=0)
    reflected = albedo if solution.specular is None else albedo + solution.specular[:, known].astype(np.float32).max(axis=0, initial=0)
    factors = [target / value for values, target in ((albedo, BRIGHT_ALBEDO), (reflected, MOST_REFLECTED)) if values.size
               and (value := float(np.percentile(values, ALBEDO_PERCENTILE))) > 0]
    return min(factors, default=1.0)
