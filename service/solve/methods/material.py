"""Normals and reflectance by the general solver, `svbrdf`, which fits a material.

It walks over the image several times: a start, the diffuse lobe that the object shares, a first search, the direct light that follows
from the height of its normals, the materials that pixels share, and the final solve.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.material.albedo_error import albedo_error
from kernels.photometric.material.blurred_metals import LEAST_LIGHTS
from kernels.photometric.material.lost_light import account_light
from kernels.photometric.material.material import MATT, fit_given, fit_tinted
from kernels.photometric.material.mixtures import HELD
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.samples import Samples, evenly
from kernels.photometric.search.descent import descend
from kernels.photometric.search.hypotheses import LobeShape, Prior
from kernels.photometric.search.light_factors import find_light_factors
from kernels.photometric.search.lobe_shape import UNKNOWN_SPREAD, choose_lobe_shape
from kernels.photometric.search.normal_search import find_normals, neighbours
from kernels.photometric.search.shared_misfit import UNKNOWN_SHARE, shared_misfit
from kernels.photometric.search.survey import QUICK
from kernels.photometric.shadows.bounce import bounce_albedo
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.status import ESTIMATED, Status
from service.requests.solve import Method
from service.sharing.sharing import Results
from service.solve.base.batches import Batch, ReadBand, each_band, each_batch, pick_pixels, view_directions
from service.solve.base.solution import Solution, SolveInput, half, raise_error
from service.solve.height.direct_light import DirectLight, direct_light
from service.solve.height.interreflection import ArrivingLight
from service.solve.height.part_scene import Material
from service.solve.methods.blurred import place_blurred_metals
from service.solve.methods.brushed import FEWEST_LIGHTS, place_brushed
from service.solve.methods.diffuse import APART, pair_starts
from service.solve.methods.kinds import LOBE_PIXELS, Kind, Kinds, lobe_report
from service.solve.methods.material_options import WHOLE_SOLVER, MaterialOptions
from service.solve.methods.settling import settle
from service.solve.methods.support import FEW_LIGHTS, simpler_normals, support_of
from service.solve.methods.unseen_metals import replace_unseen_metals
from stage.colour.colour import GREY_WEIGHTS

SHARED_PAIRS = 384
"""Pairs of neighbouring pixels, spread over the object, from which the part of the misfit that they share is measured."""
INTENSITY_SQUARES = 8
"""Number of squares along the longer side of the image; intensities found in one half of them must explain the other half."""

CLEAR = 0.3
"""Part of the solved pixels, those at which the least bounced light arrives, that tell the shape of the lobes once that light is known.
Normals of 21 path-traced folds are 2.14° off in the mean so, 2.20° with half of the pixels, 2.38° with the shape of the whole readings."""


def solve_material(given: SolveInput, lights: Lights, field: NearField | None = None,
                   options: MaterialOptions = WHOLE_SOLVER, once: bool = False) -> Solution:
    """Solve every pixel of the mask for normal, diffuse albedo, F0 and roughness. `once`: no rounds under near lights follow, so that lobes
    and intensities are found as under distant ones."""
    walk = _Walk(given, lights, field, options, once=once)
    walk.start()
    walk.choose_shape()
    walk.search()
    light = walk.refine_intensities(walk.direct_light())
    walk.fit(light, walk.choose_kinds(light))
    return walk.result


def refine_material(given: SolveInput, lights: Lights, field: NearField, before: Solution) -> Solution:
    """Solve again from a solution of `solve_material`, or of this function: shadows and interreflection follow from its surface, and no
    first search is needed."""
    walk = _Walk(given, lights, field, WHOLE_SOLVER, once=False)
    walk.start()
    walk.resume(before)
    light = walk.direct_light()
    walk.choose_shape(light)
    walk.fit(light, walk.choose_kinds(light))
    return walk.result


class _Walk:
    """The state of a solve between its passes over the image."""

    def __init__(self, given: SolveInput, lights: Lights, field: NearField | None, options: MaterialOptions, *, once: bool) -> None:
        self._once = once or field is None
        self._given, self._lights, self._field, self._options = given, lights, field, options
        self._view = view_directions(given.camera)
        self._interreflection = options.interreflection
        count = given.stack.pixel_count
        self.result = Solution.empty(count)
        self._specular = self.result.specular = np.zeros((3, count), np.float16)
        self._roughness = self.result.roughness = np.zeros(count, np.float16)
        self._simple = np.zeros_like(self.result.normal)  # normals that it is drawn to where few lights do not support more
        self._robust = self.result.normal
        self._unknown_bounce: np.ndarray | float = 0.0  # degrees, [pixels], by which an unknown strength of that light turns normals
        self._bouncing = np.zeros((3, count), np.float32)  # albedo of the light that other surfaces send
        self._shape, self._lobe, self._shape_spread = LobeShape(), LobeShape(), UNKNOWN_SPREAD
        self._resumed = False
        self._supported, self._pull, self._simpler = True, 0.0, Method.LAMBERT
        self._unsupported: str | None = None  # what few lights do not support

    def start(self) -> None:
        """Find the normals of `robust`, from which the search begins, and under few lights those of `lambert`."""
        self._given.timings.stage("start", self._given.stack.shape[2])

        def begin(read: ReadBand) -> None:
            span, inside, band, readings, near = read
            self.result.place(span, inside, solve_robust(band, readings, self._lights.direction, near))
            if self._few:
                grey = grey_readings(band, grey_factors(self._lights, GREY_WEIGHTS))
                fit = solve_lambert(band, grey, self._lights.direction, near)
                status, normal = (to_numpy(each) for each in (fit.status, fit.normal))
                self._simple[:, span] = np.where(status[: len(inside)] == Status.OK, normal[:, : len(inside)],
                                                     self.result.normal[:, span])

        each_band(self._given, self._lights, self._field, begin,
                  Results((self.result.normal, self.result.residual, self.result.status, self._simple)))
        if self._few:
            self._robust = self.result.normal.copy()
        self._solvable = np.flatnonzero(self.result.status == Status.OK)
        self._spread = self._solvable[evenly(len(self._solvable), LOBE_PIXELS)]

    def resume(self, before: Solution) -> None:
        """Take normals, albedo and roughness of the pixels that are solved from an earlier solution."""
        solved = np.isin(before.status, ESTIMATED) & (self.result.status == Status.OK)
        assert before.roughness is not None
        self.result.normal[:, solved], self.result.albedo[:, solved] = before.normal[:, solved], before.albedo[:, solved]
        self._roughness[solved] = before.roughness[solved]
        self._bouncing[:, solved] = before.albedo[:, solved]
        self._resumed = True

    def choose_shape(self, light: DirectLight | None = None) -> None:
        """Choose the shape of the lobes, and find out whether few lights support the lobes at all."""
        self._given.timings.stage("shape", 1)
        if not len(self._spread):
            return
        if self._few:
            start = pair_starts(self._solved, LOBE_PIXELS)
            pixels = np.concatenate([start, start + APART]) if len(start) else np.tile(self._spread, 2)
            support = support_of(self.result, self._read(pixels, light), self.result.normal[:, pixels].T, matt=self._matt)
            self._supported, self._simpler, self._pull, self._unsupported = support
            self._simple = self._robust if support.simpler is Method.ROBUST else self._simple
        if self._supported:
            self._shape_of(self._spread, light)

    def _shape_of(self, pixels: np.ndarray, light: DirectLight | None, short_tails: bool | None = None) -> None:
        """Choose the shape of the lobes from some pixels; `short_tails` as of `choose_lobe_shape`."""
        shapes = choose_lobe_shape(self._read(pixels, light), self.result.normal[:, pixels].T, short_tails=short_tails)
        self._shape, self._lobe, self._shape_spread = shapes.mean, shapes.best, shapes.spread
        self.result.facts |= {**lobe_report(self._lobe), "shapes_tried": len(shapes.tried)}

    def search(self) -> None:
        """Search the normals a first time, and fit the material from which shadows and interreflection are told."""
        result = self.result

        def search(batch: Batch) -> None:
            pixels, samples = batch
            start = result.normal[:, pixels] if self._supported else self._simple[:, pixels]
            found = find_normals(samples, start.T, shape=self._shape, prior=self._prior(pixels), beside=self._beside(pixels), sweep=QUICK)
            normal = found.best.normal
            result.normal[:, pixels] = normal.T
            if self._interreflection:
                first = (fit_tinted(samples, normal, shape=self._lobe) if self._supported and not self._matt else
                         fit_given(samples, normal, MATT, shape=self._lobe))
                result.albedo[:, pixels], self._roughness[pixels] = half(first.diffuse_albedo.T), first.roughness
                self._specular[:, pixels] = first.specular.T
                self._bouncing[:, pixels] = bounce_albedo(samples, normal, first, shape=self._lobe).T

        self._batches("search", search, Results((result.normal, result.albedo, self._specular, self._roughness, self._bouncing),
                                                (self._shape, self._lobe, self._supported)))

    def direct_light(self) -> DirectLight | None:
        """Find what the object does to its own light, from the first search, and the shape of the lobes again from where little light
        bounces; None when no pixel is solved."""
        solved = self._solved
        material = Material(self.result.albedo.copy(), self._specular.copy(), self._roughness.copy())
        light = direct_light(self._given, self._lights, self._field, self.result.normal, material, self._bouncing, solved,
                             shadows=self._options.shadows, interreflection=self._interreflection,
                             parts=self._options.parts and self._interreflection)
        if light is None or light.arriving is None or not self._options.settling:
            return light
        if self._supported and self._once:
            self._shape_of(self._clear(light.arriving), light, self._shape.short_tails)
        relative = self._given.relative and self._options.scale
        self._given.timings.stage("bounced", 1)
        settled = settle(light, self.result.normal, self._shape, self._pick, relative=relative, direct=self._resumed)
        self._unknown_bounce = settled.degrees
        self.result.facts |= settled.report(relative=relative)
        self.result.warnings += settled.warnings()
        return settled.light

    def _clear(self, arriving: ArrivingLight) -> np.ndarray:
        """Return LOBE_PIXELS of the pixels, spread over the object, at which little bounced light arrives."""
        amount = arriving.mean_at(*np.divmod(self._solvable, self._given.camera.width))
        clear = self._solvable[amount <= np.quantile(amount, CLEAR)]
        return clear[evenly(len(clear), LOBE_PIXELS)]

    def refine_intensities(self, light: DirectLight | None) -> DirectLight | None:
        """Replace the intensities of the lights where the object shows that others explain it better; returns the direct light of them."""
        told = (self._supported and not self._few and self._once and self._options.intensities
                and self._given.refine_intensities)
        if light is None or not told:
            return light
        samples, count = self._read(self._spread, light), self._given.stack.light_count
        square = max(self._given.mask.shape) / INTENSITY_SQUARES
        row, col = (np.floor(part / square).astype(int) for part in np.divmod(self._spread, self._given.camera.width))
        start, directions = self.result.normal[:, self._spread].T, self._lights.direction[:count]
        found = find_light_factors(samples, start, directions, row, col, shape=self._shape)
        self.result.facts["light_factors"] = {"believed": found.believed, "left_out_gain": round(found.gain, 4)}
        if not found.believed:
            return light
        self.result.facts["light_factors"] |= {"spread": round(float(np.std(np.log(found.factor))), 4),
                                               "factors": found.factor.round(4).tolist()}
        irradiance = self._lights.irradiance.copy()
        irradiance[:count] *= found.factor[:, None]
        self._lights = self._lights._replace(irradiance=irradiance)
        return light.under(self._lights, found.factor)

    def choose_kinds(self, light: DirectLight | None) -> Kinds:
        """Return the shapes of lobes and the materials that pixels share, without materials where they share none."""
        kinds = Kinds(Kind(self._shape, self._lobe, self._shape_spread), self._given.stack.pixel_count)
        if light is None or not (self._options.sharing and self._supported):
            return kinds
        read, normal, options = partial(self._read, light=light), self.result.normal, self._options
        kinds.tell_apart(to_numpy(light.solved).reshape(-1), self._solvable, read, normal)
        kinds.find_materials(self._solvable, read, normal, self._given.camera.width, metals=options.metals, mixtures=options.mixtures)
        whole, *others = ({"pixels": int((kinds.which[self._solvable] == number).sum()), **kind.report()}
                          for number, kind in enumerate(kinds.kinds))
        self.result.facts["shared_materials"] = whole["shared_materials"]
        if others:
            self.result.facts["other_parts"] = others
        return kinds

    def fit(self, light: DirectLight | None, kinds: Kinds) -> None:
        """Fit normal and material of every pixel to its direct light."""
        result = self.result
        count = self._given.stack.pixel_count
        sigma = self.result.sigma
        sigma[:] = LARGEST_ERROR
        abundance, pair = np.zeros(count, np.float16), np.zeros(count, np.uint8)
        own, tilt = np.zeros_like(result.albedo), np.zeros_like(result.albedo)
        misread = np.zeros(count, np.float16)  # share of the light, of pixels whose material loses most of it
        shown = np.ones(count, np.float16)  # share of the predicted light
        shared = self._shared_misfit(light)
        light_on = {} if light is None else {device: light.on(device) for device in self._given.devices}  # None: there are no pixels

        def fit(batch: Batch) -> None:
            pixels, samples = batch
            light_on[samples.device].keep(pixels, samples)
            if self._pull:
                self._simple[:, pixels] = simpler_normals(samples, self._simpler, self._simple[:, pixels].T).T
            for at, kind, first_pair in kinds.groups(pixels):
                fit_kind(pixels[at], samples if len(at) == len(pixels) else choose(samples, at), kind, first_pair)

        def fit_kind(pixels: np.ndarray, samples: Samples, kind: Kind, first_pair: int) -> None:
            roughness = self._roughness[pixels].astype(np.float32) if self._interreflection else None
            found = solve_svbrdf(samples, result.normal[:, pixels].T, shape=kind.shape, lobe=kind.lobe, shared=kind.materials,
                                 pairs=kind.pairs, metals=kind.metals, roughness=roughness, prior=self._prior(pixels),
                                 beside=self._beside(pixels), shared_misfit=shared, shape_spread=kind.spread)
            result.normal[:, pixels] = found.normal.T
            plain = self._matt or self._pull > 0
            material = fit_given(samples, found.normal, MATT, shape=kind.lobe) if plain else found
            result.albedo[:, pixels] = half(material.diffuse_albedo.T)
            self._specular[:, pixels] = material.specular.T
            self._roughness[pixels] = material.roughness
            error = albedo_error(samples, found.normal, material, shape=kind.lobe, shared=MATT[None] if plain else kind.materials)
            own[:, pixels], tilt[:, pixels] = (half(each.T) for each in error)
            if not plain:
                abundance[pixels], pair[pixels] = found.mixture
                pair[pixels[found.mixture.abundance > 0]] += np.uint8(first_pair)
            sigma[pixels], result.residual[pixels] = found.sigma, found.residual
            if self._seeks_metals:
                misread[pixels], shown[pixels] = account_light(samples, found.normal, found)

        self._batches("normals", fit, Results(
            (result.normal, result.albedo, self._specular, self._roughness, abundance, pair, sigma, result.residual, own, tilt, misread,
             shown),
            (None if light is None else light.found, kinds.which, kinds.kinds, self._supported, shared)))
        raise_error(result, self._unknown_bounce)
        result.shared_misfit, result.albedo_own, result.albedo_tilt = shared, own, tilt
        read, shape = partial(self._read, light=light), self._given.mask.shape
        abundance[replace_unseen_metals(result, shown, shape, kinds, read)] = 0
        if self._given.stack.light_count >= LEAST_LIGHTS:
            blurred = place_blurred_metals(result, misread, shape, read)
            abundance[blurred], own[:, blurred], tilt[:, blurred] = 0, 0, 0
        if not self._matt and self._given.stack.light_count >= FEWEST_LIGHTS:
            abundance[place_brushed(result, self._solvable, shape, self._pick, self._given.timings, lobe=self._lobe)] = 0
        if self._unsupported and not result.mostly_brushed:
            result.warnings.append(self._unsupported)
        if (mixed := abundance > 0).any():
            result.abundance, result.pair, result.pairs = abundance, pair, kinds.pairs
            result.facts["mixed_pixels"] = int(mixed.sum())

    def _shared_misfit(self, light: DirectLight | None) -> float:
        """Return the share of the misfit that neighbouring pixels have in common."""
        start = pair_starts(self._solved, SHARED_PAIRS)
        if light is None or not len(start):
            return UNKNOWN_SHARE
        pixels = np.concatenate([start, start + APART])
        samples = self._read(pixels, light)
        shared = shared_misfit(samples, descend(samples, self.result.normal[:, pixels].T, shape=self._shape), shape=self._shape)
        self.result.facts["shared_misfit"] = round(shared, 4)
        return shared

    @property
    def _solved(self) -> np.ndarray:
        """Return [rows, cols] bool, which pixels have a normal."""
        return (self.result.status == Status.OK).reshape(self._given.mask.shape)

    @property
    def _seeks_metals(self) -> bool:
        return self._options.metals and self._supported and not self._matt

    @property
    def _few(self) -> bool:
        return self._given.stack.light_count < FEW_LIGHTS

    @property
    def _matt(self) -> bool:
        """Return whether the images hold diffuse light alone, so that a specular lobe explains nothing but noise."""
        return self._given.pairs is not None

    def _beside(self, pixels: np.ndarray) -> np.ndarray:
        return neighbours(pixels, self._given.camera.width)

    def _prior(self, pixels: np.ndarray) -> Prior | None:
        """Return what is expected of the normals of some pixels."""
        return Prior(self._simple[:, pixels].T, self._pull) if self._pull else None

    def _pick(self, pixels: np.ndarray) -> Samples:
        """Return the readings of a few pixels, wherever they lie in the image."""
        return pick_pixels(self._given, self._lights, self._view, pixels, self._field)

    def _read(self, pixels: np.ndarray, light: DirectLight | None) -> Samples:
        """Return the readings of a few pixels as `_pick` does, in their direct light where that is known."""
        samples = self._pick(pixels)
        if light is not None:
            light.keep(pixels, samples)
        return samples

    def _batches(self, stage: str, work: Callable[[Batch], None], results: Results) -> None:
        """Do the solvable pixels batch by batch, and say how far the stage is."""
        self._given.timings.stage(stage, len(self._solvable))
        each_batch(self._given, self._lights, self._view, self._solvable, work, results, lobes=HELD, field=self._field)
