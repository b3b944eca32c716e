"""Polarised pairs in a solve: normals and albedo from diffuse light, F₀ and roughness from highlights, and metals without diffuse light.

The specular lobes are fitted to S + D̂, with D̂ the diffuse light that normals and albedo explain: noise of S around zero then stays
around D̂, where the fits, which take no negative reading, keep it. Where the diffuse images are in shadow, the measured D stands for D̂.

A metal has no diffuse reflection: its diffuse images are noise and what leaks through the polarisers. Its normals are solved from the sum
of both images, as without polarisers, and its diffuse albedo is that of the diffuse images under these normals.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import Lights
from kernels.photometric.material.material import fit_material
from kernels.photometric.material.mixtures import HELD
from kernels.photometric.material.shared_materials import choose_materials
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.search.hypotheses import LobeShape
from kernels.status import ESTIMATED
from service.sharing.sharing import Results
from service.solve.base.batches import Batch, each_batch, pick_pixels, view_directions
from service.solve.base.solution import SeparatedPairs, Solution, SolveInput
from service.solve.methods.kinds import material_report, smoothest
from service.solve.methods.near import NormalSolver
from service.solve.methods.pairs import PairFindings, examine_pairs
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import FILE_NAME
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.capture.polarised_pairs import Component, first_in_place
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import ManifestError
from stage.stack.brackets import merge_brackets, one_frame_a_light
from stage.stack.stack import Stack

LEAST_DIFFUSE = 0.1
"""Diffuse light over specular light, means over the lights, below which a pixel counts as one without diffuse light: of metals it is 2ε
where polarisers leak the part ε and nobody says so, 0.04 of usual ones; of a black glossy paint of albedo 0.01 it is 0.25."""
LEAST_LIGHT = 0.01
"""Mean light of a pixel, over the median of the object, below which nothing is said of its polarisation: both parts are noise."""
SHADOW_DEPTH = 0.3
"""Diffuse reading over its prediction below which it is in shadow, as in the search for normals."""


class Separated(NamedTuple):
    """The images of polarised pairs, taken apart."""

    diffuse: Stack
    lights: DistantLights | PlacedLights
    pairs: SeparatedPairs


def separate_pairs(stack: Stack, capture: Capture, lights: DistantLights | PlacedLights, mask: np.ndarray) -> Separated:
    """Take the images of polarised pairs apart.
    Raises ManifestError: the images of a pair are swapped, shifted, or not of the same light; names them."""
    declared = capture.manifest.polarizer_leak
    leak, sources = declared or 0.0, capture.sources()

    def part(component: Component) -> Stack:
        merged = merge_brackets(stack, sources, lights, component=component, leak=leak)
        return one_frame_a_light(merged, lights)[0]

    diffuse, kept = one_frame_a_light(merge_brackets(stack, sources, lights, component=Component.DIFFUSE, leak=leak), lights)
    found = examine_pairs(part(Component.CROSS), part(Component.PARALLEL), _partners(capture, lights, diffuse), mask)
    if found.fault is not None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].light.polarization: {found.fault}")
    facts = {"pairs": diffuse.light_count, "leak": leak, "leak_declared": declared is not None,
             "leak_at_most": None if found.leak_at_most is None else round(found.leak_at_most, 4), "noise": round(found.noise, 5)}
    return Separated(diffuse, kept, SeparatedPairs(part(Component.SPECULAR), part(Component.WHOLE), facts, _leak_warnings(leak, found)))


def solve_pairs(given: SolveInput, lights: Lights, field: NearField | None, solver: NormalSolver, of_metals: NormalSolver) -> Solution:
    """Solve diffuse images by `solver`, without the metals, of which they hold noise; specular lobes from the specular images; and metals
    from the sum, by `of_metals`."""
    pairs = given.pairs
    assert pairs is not None
    metal = without_diffuse(given)
    diffuse = solver(replace(given, mask=given.mask & ~metal.reshape(given.mask.shape)), lights, field)
    diffuse.abundance = diffuse.pair = diffuse.pairs = None
    diffuse.facts.pop("mixed_pixels", None)
    diffuse.facts.pop("shared_materials", None)
    diffuse.facts["polarisation"] = pairs.facts | {"pixels_without_diffuse_light": int(metal.sum())}
    if metal.any():
        _solve_metals(given, lights, field, diffuse, metal, of_metals)
    _fit_lobes(given, lights, field, diffuse, np.isin(diffuse.status, ESTIMATED) & ~metal)
    return diffuse


def doubt_metals(given: SolveInput, solution: Solution) -> None:
    """Make the normals of pixels without diffuse light unsure, for methods that look at diffuse light alone."""
    assert given.pairs is not None
    metal = without_diffuse(given)
    solution.facts["polarisation"] = given.pairs.facts | {"pixels_without_diffuse_light": int(metal.sum())}
    sigma = solution.standard_error()
    solution.sigma = np.where(metal & np.isin(solution.status, ESTIMATED), LARGEST_ERROR, sigma).astype(np.float16)
    if metal.any():
        solution.warnings.append(f"{int(metal.sum())} pixels have hardly any diffuse light, as metals: --method svbrdf solves them from "
                                 "their highlights, which keep polarisation")


def without_diffuse(given: SolveInput) -> np.ndarray:
    """Return [pixels] bool, where the light of a pixel of the mask keeps its polarisation."""
    assert given.pairs is not None
    diffuse, specular = (_mean_light(stack) for stack in (given.stack, given.pairs.specular))
    inside = given.mask.reshape(-1)
    whole = diffuse + specular
    seen = inside & (whole > LEAST_LIGHT * np.median(whole[inside]))
    return seen & (diffuse < LEAST_DIFFUSE * specular)


def _solve_metals(given: SolveInput, lights: Lights, field: NearField | None, diffuse: Solution, metal: np.ndarray,
                  solver: NormalSolver) -> None:
    """Solve the pixels without diffuse light from the sums; their albedo is that of the diffuse images."""
    assert given.pairs is not None
    whole = replace(given.whole, mask=metal.reshape(given.mask.shape))
    found = solver(whole, lights._replace(scale=whole.stack.scale), field)
    for name in ("normal", "specular", "roughness", "residual", "status", "sigma", "albedo_own", "albedo_tilt"):
        getattr(diffuse, name)[..., metal] = getattr(found, name)[..., metal]
    pixels = np.flatnonzero(metal & np.isin(diffuse.status, ESTIMATED))
    top, bottom = np.zeros((3, len(pixels))), np.full((3, len(pixels)), 1e-12)
    model = DiffuseModel(lights, field, diffuse.normal, np.ones_like(diffuse.albedo))
    values, bits = given.stack.pick(pixels)
    usable = np.unpackbits(bits, axis=0, bitorder="little")[: values.shape[1]] == 0
    for light in range(given.stack.light_count):
        expected = model.radiance(light, pixels)
        reading = values[:, light].astype(np.float64) * given.stack.scale[light]
        top += np.where(usable[light], expected * reading, 0)
        bottom += np.where(usable[light], expected**2, 0)
    diffuse.albedo[:, pixels] = np.clip(top / bottom, 0, 1)


def _fit_lobes(given: SolveInput, lights: Lights, field: NearField | None, solution: Solution, solved: np.ndarray) -> None:
    """Fit F₀ and roughness of solved pixels to the specular images."""
    assert given.pairs is not None
    solution.specular, solution.roughness = (np.array(layer) for layer in (solution.specular, solution.roughness))
    specular, roughness = solution.specular, solution.roughness
    pixels = np.flatnonzero(solved)
    if not len(pixels):
        return
    model = DiffuseModel(lights, field, solution.normal, solution.albedo)
    stack = OnDiffuseModel.of(given.pairs.specular, given.stack, model)
    here, lit = replace(given, stack=stack), lights._replace(scale=stack.scale)
    view, shape = view_directions(given.camera), LobeShape()
    spread = smoothest(pixels, solution.normal, given.camera.width)
    samples = pick_pixels(here, lit, view, spread, field)
    materials = choose_materials(samples, solution.normal[:, spread].T, shape=shape)
    solution.facts["shared_materials"] = material_report(materials)
    given.timings.stage("highlights", len(pixels))

    def fit(batch: Batch) -> None:
        found = fit_material(batch.samples, solution.normal[:, batch.pixels].T, shape=shape, shared=materials)
        specular[:, batch.pixels] = found.specular.T
        roughness[batch.pixels] = found.roughness

    each_batch(here, lit, view, pixels, fit, Results((specular, roughness), (materials, solution.normal, solution.albedo)), lobes=HELD,
               field=field)


def _mean_light(stack: Stack) -> np.ndarray:
    """Return [pixels] the grey radiance of a stack, mean over the lights."""
    mean = np.zeros(stack.pixel_count)
    weight = np.array(GREY_WEIGHTS)[:, None] * stack.scale[: stack.light_count] / stack.light_count
    for start, stop in stack.bands(4 * stack.shape[1]):
        values = stack.band(start, stop)[:, : stack.light_count]
        mean[start:stop] = np.einsum("cl,clp->p", weight, values.astype(np.float32))[: stack.pixel_count - start]
    return mean


class DiffuseModel(NamedTuple):
    """The diffuse light of Lambertian pixels."""

    lights: Lights
    field: NearField | None
    normal: np.ndarray  # [3, pixels]
    albedo: np.ndarray  # [3, pixels]

    def radiance(self, light: int, pixels: np.ndarray) -> np.ndarray:
        """Return [3, n] float32 of some pixels under a light."""
        normal = self.normal[:, pixels].astype(np.float32)
        if self.field is None:
            cosine: np.ndarray = self.lights.direction[light] @ normal
        else:
            place, lobe = self.field.places.place[light], self.field.places.lobe[light]
            way = place[:3, None] - place[3] * self.field.points[:, pixels]
            squared = np.maximum((way**2).sum(axis=0), 1e-20)
            toward = way / np.sqrt(squared)
            falloff = np.where(place[3] == 1, 1 / squared, 1.0)
            if lobe[3] > 0:
                falloff = falloff * np.maximum(-(lobe[:3] @ toward), 0) ** lobe[3]
            cosine = (toward * normal).sum(axis=0) * falloff
        return np.asarray(self.albedo[:, pixels].astype(np.float32) / np.pi * self.lights.irradiance[light][:, None]
                          * np.maximum(cosine, 0), dtype=np.float32)


@dataclass(frozen=True)
class OnDiffuseModel(Stack):
    """Specular images on the diffuse light that normals and albedo explain."""

    specular: Stack | None = None
    diffuse: Stack | None = None
    model: DiffuseModel | None = field(default=None, compare=False)

    @classmethod
    def of(cls, specular: Stack, diffuse: Stack, model: DiffuseModel) -> "OnDiffuseModel":
        """Return the sums of specular images and a model of the diffuse ones."""
        scale = np.where(specular.scale > 0, 2 * np.maximum(specular.scale, diffuse.scale), 0).astype(np.float32)
        return cls(specular.folder, specular.key, specular.frames, scale, specular.pixel_count, specular=specular, diffuse=diffuse,
                   model=model)

    def band(self, start: int, stop: int) -> np.ndarray:
        """Return the values of a pixel range, [3, lights padded, stop - start] float16."""
        assert self.specular is not None and self.diffuse is not None
        return self._add(np.arange(start, stop), self.specular.band(start, stop), self.diffuse.band(start, stop))

    def saturated(self, start: int, stop: int) -> np.ndarray:
        """Return the bits of clipped readings, [lights padded / 8, stop - start] uint8."""
        assert self.specular is not None
        return self.specular.saturated(start, stop)

    def pick(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values [3, lights padded, n] float16 and bits [lights padded / 8, n] uint8 of single pixels."""
        assert self.specular is not None and self.diffuse is not None
        values, bits = self.specular.pick(pixels)
        return self._add(pixels, values, self.diffuse.pick(pixels)[0]), bits

    def pick_saturated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the bits of single pixels, [lights padded / 8, n] uint8."""
        assert self.specular is not None
        return self.specular.pick_saturated(pixels)

    def _add(self, pixels: np.ndarray, specular: np.ndarray, diffuse: np.ndarray) -> np.ndarray:
        assert self.model is not None and self.specular is not None and self.diffuse is not None
        total = np.zeros(specular.shape, np.float16)
        inside = pixels < self.pixel_count
        for light in range(self.light_count):
            expected = self.model.radiance(light, pixels[inside])
            measured = diffuse[:, light, inside].astype(np.float32) * self.diffuse.scale[light]
            shadowed = measured.sum(axis=0) < SHADOW_DEPTH * expected.sum(axis=0)
            whole = specular[:, light, inside].astype(np.float32) * self.specular.scale[light] + np.where(shadowed, measured, expected)
            total[:, light, inside] = np.clip(whole / self.scale[light], -65504, 65504)
        return total


def _partners(capture: Capture, lights: DistantLights | PlacedLights, stack: Stack) -> list[tuple[str, str]]:
    """Return the names of the first cross and the first parallel image of every light of a stack."""
    frames = capture.sources()
    owner = first_in_place(lights.place if isinstance(lights, PlacedLights) else lights.direction)
    names: dict[int, dict[str, str]] = {}
    for frame, first in zip(frames, owner, strict=True):
        assert isinstance(frame.light, DistantLight | PointLight)
        names.setdefault(int(first), {}).setdefault(frame.light.polarization, frame.image)
    of_image = {frame.image: int(first) for frame, first in zip(frames, owner, strict=True)}
    return [(names[of_image[image]]["cross"], names[of_image[image]]["parallel"]) for image in stack.frames]


def _leak_warnings(leak: float, found: PairFindings) -> list[str]:
    """Return a sentence where the images show that the polarisers leak less than is declared."""
    if found.leak_at_most is None or leak <= found.leak_at_most:
        return []
    return [f"polarizer_leak: is {leak:g}, the images show {found.leak_at_most:.3g} or less: what is too much is taken off the diffuse "
            "images at highlights"]

