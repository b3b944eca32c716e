"""The methods of `relit solve`: what each needs of a capture, and the functions that solve it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import Lights, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from service.requests.solve import SVBRDF_LIGHTS, Method
from service.solve.base.solution import Solution, SolveInput
from service.solve.methods.diffuse import solve_diffuse
from service.solve.methods.near import MATERIAL_ROUNDS, NormalSolver, Rounds, solve_near, solve_once
from service.solve.methods.reference_ball import ReferenceBall, reference_ball
from stage.capture.capture import Capture
from stage.capture.gradients import GradientFrames, gradient_frames, has_gradients
from stage.capture.light import DistantLight, ExtendedLight, PointLight
from stage.capture.lighting import ExtendedLights, check_solvable
from stage.capture.point_lights import DistantLights, PlacedLights

Solver = Callable[[SolveInput, Any], Solution]


class MethodEntry(NamedTuple):
    """One method: what it needs of a capture, and the functions that solve it."""

    read_lights: Callable[..., Any]
    """Returns the lights or frames that the method works with. Takes the capture, and that of the reference ball where there is one;
    raises a StageError that says what they lack."""
    solvers: Mapping[type, Solver]
    """One function for each kind of lights; a kind that is not here is refused."""
    residual: str
    """The meaning of the residual of a pixel, for the report."""
    is_default: Callable[[Capture], bool] = lambda capture: False
    """True if a capture is solved by this method when the request names none."""


def _suits_svbrdf(capture: Capture) -> bool:
    places = {light.position_m if isinstance(light, PointLight) else light.direction
              for frame in capture.sources() if isinstance(light := frame.light, DistantLight | PointLight)}
    return bool(capture.lit_by(ExtendedLight)) or len(places) >= SVBRDF_LIGHTS  # exposures of one light are one


def _solve_distant(given: SolveInput, lights: DistantLights, *, solver: NormalSolver) -> Solution:
    """Solve every pixel of the mask under distant lights."""
    return solver(given, pad_lights(lights.direction, lights.irradiance, given.stack.scale))


def _single_lights(*series: Rounds) -> dict[type, Solver]:
    """Return the functions for lights of one direction each: distant lights are solved by the last solver of those for near ones."""
    return {DistantLights: partial(_solve_distant, solver=series[-1].solver), PlacedLights: partial(solve_near, series=series)}


# solvers that few captures need are imported, with their kernels, when they are called: all of them take a tenth of a second


def _solve_material(given: SolveInput, lights: Lights, field: NearField | None = None) -> Solution:
    from service.solve.methods.material import solve_material

    return _with_highlights(given, lights, field, solve_material)


def _refine_material(given: SolveInput, lights: Lights, field: NearField, before: Solution) -> Solution:
    from service.solve.methods.material import refine_material

    return _with_highlights(given, lights, field, partial(refine_material, before=before))


def _with_highlights(given: SolveInput, lights: Lights, field: NearField | None, solver: NormalSolver) -> Solution:
    if given.pairs is None:
        return solver(given, lights, field)
    from service.solve.methods.material import solve_material
    from service.solve.methods.polarised import solve_pairs

    return solve_pairs(given, lights, field, solver, solve_material)


def _solve_extended(given: SolveInput, lights: ExtendedLights) -> Solution:
    from service.solve.methods.extended import solve_extended

    return solve_extended(given, lights)


def _solve_gradients(given: SolveInput, frames: GradientFrames) -> Solution:
    from service.solve.methods.gradient import solve_gradients

    return solve_gradients(given, frames)


def _solve_by_reference(given: SolveInput, ball: ReferenceBall) -> Solution:
    from service.solve.methods.reference import solve_by_reference

    return solve_by_reference(given, ball)


LAMBERT = Rounds(Method.LAMBERT, partial(solve_diffuse, fit_normals=solve_lambert))
ROBUST = Rounds(Method.ROBUST, partial(solve_diffuse, fit_normals=solve_robust))
MATERIAL = Rounds(Method.SVBRDF, _solve_material, MATERIAL_ROUNDS, _refine_material)

OF_THE_LARGEST = ("of grey readings over irradiance less b·l, relative to the length of b, which is the reading under a light along "
                  "the normal")
IN_NOISE = ("square root of the mean over the lights of log(1 + r²/σ²), where r is reading less model and σ the noise that the search "
            "assumes: 0.83 where r is σ everywhere; a shadow counts 1")

METHODS: Mapping[Method, MethodEntry] = {
    Method.GRADIENT: MethodEntry(gradient_frames, {GradientFrames: _solve_gradients},
                                 "root mean square of the grey readings less the fit, relative to the reading under the full frame",
                                 has_gradients),
    Method.SVBRDF: MethodEntry(check_solvable, {**_single_lights(ROBUST, MATERIAL), ExtendedLights: _solve_extended}, IN_NOISE,
                               _suits_svbrdf),
    Method.ROBUST: MethodEntry(check_solvable, _single_lights(ROBUST),
                               f"root mean square, by the weights of the fit and without rejected readings, {OF_THE_LARGEST}",
                               is_default=lambda capture: True),
    Method.LAMBERT: MethodEntry(check_solvable, _single_lights(LAMBERT), f"root mean square {OF_THE_LARGEST}"),
    Method.REFERENCE: MethodEntry(reference_ball, {ReferenceBall: _solve_by_reference}, IN_NOISE),
}
"""Every method. The default for a capture is the first whose `is_default` says so."""


def solve_in_rig(given: SolveInput, lights: PlacedLights, method: Method) -> Solution:
    """Solve under lights at a distance that the images show, which is not known well enough for svbrdf to need more than one round on the
    surface of `robust`."""
    if method is not Method.SVBRDF:
        return METHODS[method].solvers[PlacedLights](given, lights)
    from service.solve.methods.material import solve_material

    return solve_once(given, lights, ROBUST, partial(solve_material, once=True))
