"""Normals and materials under extended lights (photometric sampling): tables of the lights' responses for each part of the view,
then searches in them, batch by batch.

The first search takes every source as seen by every pixel. From its height follows which sources are hidden and what light the object
throws on itself; the next searches are made in what is left.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from kernels.photometric.lambertian.readings import pad_lights
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.response_table import SEARCH_LOBES, SEARCH_WIDTHS, response_table
from kernels.photometric.posterior.modes import GRID_FLOATS, angle_degrees
from kernels.photometric.posterior.sampling import Found, Regime, SamplingTables, sampling_tables, search_sampling, solve_sampling
from kernels.status import Status
from service.requests.solve import MAX_SIGMA
from service.sharing.sharing import Results
from service.solve.base.batches import Batch, View, each_batch, readable, view_directions
from service.solve.base.solution import Solution, SolveInput, half
from service.solve.methods.open_sources import OpenSources, open_sources
from stage.capture.camera import Camera
from stage.capture.lighting import ExtendedLights

PART_DEGREES = 8.0
"""Width of a part of a perspective view that shares a table: at its edge, 4° from its middle, the normal of a metal of roughness
0.5 or 0.7 is off by another 0.3°, that of anything else by less than 0.1°."""
MOSTLY_OPEN = 0.25
"""Fraction of pixels with an open normal above which the sources do not suit the object."""
REFINEMENTS = 5
"""Searches after the first, each with the shadows and the interreflection of the surface before it; a search near a known normal is an
eighth of the work of a pixel."""
LEAST_GAIN = 0.1
"""Part by which the cost must fall for the searches in the object's own light to be kept: hollows that are there make it fall by 14 % and
more, those of a mirror whose normals are open, which are none, by 0.5 to 4 %."""
UNEXPLAINED = 0.1
"""Cost per light, mean over the pixels whose light the object changes, above which the change is not understood: it is that of readings
off by a third of the noise that the search assumes, where shadows that are found leave a hundredth to a sixtieth of it."""
LARGE_PART = 0.1
"""Part of the light of these pixels that the object changes above which that matters."""
TABLES_KEPT = 4
"""Parts of the view whose tables are kept from pass to pass on each device, some 50 megabytes each under 24 sources."""


def solve_extended(given: SolveInput, lights: ExtendedLights) -> Solution:
    """Solve every pixel of the mask for normal, diffuse albedo, F0, roughness and regime."""
    walk = _Walk(given, lights)
    walk.search()
    walk.refine()
    walk.judge()
    result = walk.result
    assert result.regime is not None
    codes = np.bincount(result.regime[given.mask.reshape(-1)], minlength=len(Regime))
    result.facts |= {"light_samples": len(lights.share), "views": walk.views,
                     "regimes": {regime.name.lower(): int(codes[regime]) for regime in Regime if regime is not Regime.UNSOLVED}}
    found = result.status == Status.OK
    open_share = float((result.sigma[found] > MAX_SIGMA).mean()) if found.any() else 0.0
    if open_share > MOSTLY_OPEN:
        result.warnings.append(f"frames[].light: at {100 * open_share:.0f} % of the pixels the readings leave the normal open by more than "
                               f"{MAX_SIGMA:g}°, as a mirror does that sees hardly any of the sources: give wider sources, or more of them")
    return result


class _Part(NamedTuple):
    """Pixels that see the object from about one side."""

    number: int
    pixels: np.ndarray  # [n] row-major positions
    rotation: np.ndarray  # [3, 3] that brings their mean direction to the viewer to z


class _Walk:
    """The state of a solve between its passes over the image: a search, searches again in what the object leaves of the light, and the
    posterior."""

    def __init__(self, given: SolveInput, lights: ExtendedLights) -> None:
        stack = given.stack
        self._given, self._lights, count = given, lights, stack.pixel_count
        self._padded = pad_lights(np.tile([0.0, 0.0, 1.0], (stack.light_count, 1)), lights.irradiance, stack.scale)
        self._view = view_directions(given.camera)
        self._parts = [_Part(number, pixels, rotation_to_z(self._view(pixels).mean(axis=0, dtype=np.float64)))
                       for number, pixels in enumerate(view_parts(given.camera, given.mask))]
        self._tables = lru_cache(TABLES_KEPT * len(given.devices))(self._tabulate)
        self._light: OpenSources | None = None
        self._doubt = np.zeros(count, np.float16)
        result = self.result = Solution.empty(count)
        result.regime = np.zeros(count, np.uint8)
        result.specular, result.roughness = np.zeros((3, count), np.float16), np.zeros(count, np.float16)
        self._found = Found(result.normal.T, np.zeros((count, 3), np.float16), np.zeros(count, bool),
                            np.zeros((count, 2 + len(SEARCH_WIDTHS)), np.float16), np.zeros(count, np.float32), result.albedo.T,
                            result.specular.T, result.roughness)

    @property
    def views(self) -> int:
        """Return the number of view directions that have tables of their own."""
        return len(self._parts)

    def search(self) -> None:
        """Search the normals over the whole visible hemisphere, as if every pixel saw every source."""
        inside = np.flatnonzero(self._given.mask.reshape(-1))

        def search(part: _Part, batch: Batch) -> None:
            pixels, samples = batch
            status = self.result.status[pixels] = readable(samples)
            found = search_sampling(samples, self._tables(part.number, samples.device), self._turned_view(part)(pixels))
            self._place(part, pixels, found, status == Status.OK)

        self._batches("search", inside, search, Results((self.result.status, *self._stored)))

    def refine(self) -> None:
        """Search again, near the normals so far, in the light that the object leaves, where it hides sources or throws light on itself.

        The searches are forgotten if they explain the readings hardly better. What the last one moved a normal by is added to its standard
        error, and so is the part of its light that the object changes, as far as a misfit shows that the change is not the right one: a
        misfit of the noise that the search assumes counts whole, as an error of the light from one side by this part.
        """
        before = Found(*(values.copy() for values in self._found))
        costs, cost = [0.0, 0.0], np.zeros(0)
        for _ in range(REFINEMENTS):
            light = open_sources(self._given, self._lights, self._padded, self.result.status, self._found, self._view)
            if light is None:
                break
            self._batches("normals", light.touched, partial(self._search_again, light),
                          Results((*self._stored, self._doubt), light.found))
            self._light, cost = light, self._found.cost[light.touched] / light.given_share
            costs = [float(before.cost[light.touched].mean()), float(cost.mean())]
        if self._light is None:
            return
        used = costs[1] < (1 - LEAST_GAIN) * costs[0]
        self.result.facts["own_light"] = {"pixels": len(self._light.touched), "cost_without": round(costs[0], 5),
                                          "cost": round(costs[1], 5), "used": used}
        if not used:
            self._light, self._doubt[:] = None, 0
            for values, first in zip(self._found, before, strict=True):
                values[:] = first
            return
        touched, change = self._light.touched, float(self._light.change.mean())
        if costs[1] > UNEXPLAINED and change > LARGE_PART:
            self.result.warnings.append(f"height: the object hides or throws on itself {100 * change:.0f} % of the light of {len(touched)} "
                                        "pixels, and that does not explain their readings: hollows may be deeper than they are solved; "
                                        "capture single lights (type distant or point), whose shadows and bounces are told apart better")
        self._doubt[touched] = np.hypot(self._doubt[touched], np.degrees(self._light.change * np.sqrt(np.minimum(cost, 1))))

    def _search_again(self, light: OpenSources, part: _Part, batch: Batch) -> None:
        """Search near the normals so far, in what the object leaves of the light."""
        pixels, samples = batch
        light.keep(pixels, samples)
        start = self._found.normal[pixels]
        found = search_sampling(samples, self._tables(part.number, samples.device), self._turned_view(part)(pixels),
                                start=(start @ part.rotation.T).astype(np.float32))
        self._place(part, pixels, found, np.ones(len(pixels), bool))
        self._doubt[pixels] = angle_degrees(start, self._found.normal[pixels])

    def judge(self) -> None:
        """Find how far the readings leave the normals open, and the regime of every pixel."""
        result, all_found = self.result, self._found

        def judge(part: _Part, batch: Batch) -> None:
            pixels, samples = batch
            assert result.specular is not None and result.roughness is not None and result.regime is not None
            if self._light is not None:
                self._light.keep(pixels, samples)
            turned = Found(*(values[pixels].astype(np.float32) if values.dtype == np.float16 else values[pixels] for values in all_found))
            turned = turned._replace(normal=(turned.normal @ part.rotation.T).astype(np.float32),
                                     other=(turned.other @ part.rotation.T).astype(np.float32))
            fit = solve_sampling(samples, self._tables(part.number, samples.device), self._turned_view(part)(pixels), found=turned)
            sigma = np.hypot(fit.sigma, self._doubt[pixels].astype(np.float32))
            result.normal[:, pixels] = (fit.normal @ part.rotation).T
            result.albedo[:, pixels] = half(fit.diffuse_albedo.T)
            result.specular[:, pixels] = fit.specular.T
            result.roughness[pixels] = fit.roughness
            result.regime[pixels] = fit.regime
            result.sigma[pixels] = np.minimum(sigma, LARGEST_ERROR)
            result.residual[pixels] = fit.residual

        assert result.specular is not None and result.roughness is not None and result.regime is not None
        self._batches("posterior", np.flatnonzero(result.status == Status.OK), judge, Results(
            (result.normal, result.albedo, result.specular, result.roughness, result.regime, result.sigma, result.residual),
            (None if self._light is None else self._light.found, self._doubt)))

    def _place(self, part: _Part, pixels: np.ndarray, found: Found, kept: np.ndarray) -> None:
        """Store what a search found at the pixels that are kept, [n] bool."""
        turned = found._replace(normal=found.normal @ part.rotation, other=found.other @ part.rotation)
        for values, new in zip(self._found, turned, strict=True):
            values[pixels[kept]] = new[kept]

    @property
    def _stored(self) -> list[np.ndarray]:
        return [values.T for values in self._found]

    def _batches(self, stage: str, chosen: np.ndarray, work: Callable[[_Part, Batch], None], results: Results) -> None:
        """Do chosen pixels, ascending positions, batch by batch and part by part, and say how far the stage is."""
        self._given.timings.stage(stage, len(chosen))
        done, lobes = 0, SEARCH_LOBES + GRID_FLOATS // self._given.stack.light_count
        for part in self._parts:
            pixels = np.intersect1d(part.pixels, chosen, assume_unique=True)
            each_batch(self._given, self._padded, self._turned_view(part), pixels, partial(work, part), results, lobes=lobes,
                       done=done)
            done += len(pixels)

    def _turned_view(self, part: _Part) -> View:
        """Return the function that gives the direction to the viewer in the frame of a part's tables."""
        return lambda pixels: (self._view(pixels) @ part.rotation.T).astype(np.float32)

    def _tabulate(self, number: int, device: str) -> SamplingTables:
        """Return the tables of a part of the view on a device."""
        lights, rotation = self._lights, self._parts[number].rotation
        return sampling_tables(response_table(lights.direction @ rotation.T, lights.solid_angle, lights.light, lights.share,
                                              light_count=self._given.stack.light_count, device=device))


def view_parts(camera: Camera, mask: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the pixels of the mask, [n] positions row by row, in parts that see the object from about one side."""
    inside = np.flatnonzero(mask.reshape(-1))
    if camera.projection == "orthographic":
        yield inside
        return
    x, y = (np.degrees(np.arctan(plane.reshape(-1)[inside])) for plane in camera.plane_coordinates())
    column, row = (_parts(angle) for angle in (x, y))
    key = row * (column.max(initial=0) + 1) + column
    for part in np.unique(key):
        yield inside[key == part]


def _parts(angle: np.ndarray) -> np.ndarray:
    """Cut the range of angles into equal parts of at most PART_DEGREES, and return the part that each angle is in."""
    width = np.ptp(angle) if angle.size else 0.0
    count = max(1, int(np.ceil(width / PART_DEGREES)))
    return np.minimum(((angle - angle.min(initial=0.0)) * count / max(width, 1e-9)).astype(int), count - 1)


def rotation_to_z(view: np.ndarray) -> np.ndarray:
    """Return [3, 3] the smallest rotation that brings a direction of the camera's half space to z."""
    x, y, z = view / np.linalg.norm(view)
    a = 1 / (1 + z)
    return np.array([[1 - a * x * x, -a * x * y, -x], [-a * x * y, 1 - a * y * y, -y], [x, y, z]])
