"""The light of wide sources that reaches an object: how much of each source a pixel sees, and the light that the object throws on itself.

From the normals so far follows a height. From every pixel, lines to places that are spread over the sources are followed over it. What the
pixel reflects of the visible places, over what it would reflect of all, is the part of the source that it sees: of a source that is
hidden where a highlight comes from, metal sees nothing, and paint the rest. Interreflection is that of distant lights.

Sources: visibility integrated over light, Zhukov, Iones and Kronin, "An ambient light illumination model", EGWR 1998, here with the
reflection and for each source; Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991.
"""

import math
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.photometric.lambertian.readings import Lights, channel_weights
from kernels.photometric.model.samples import Samples
from kernels.photometric.posterior.sampling import SHARP, Found
from kernels.photometric.shadows.bounce import subtract_bounce
from kernels.photometric.shadows.shadowing import LEAST_PART, divide_by_visible
from kernels.relight.shadows.occlusion import see_lights
from kernels.status import Status
from service.solve.base.batches import View
from service.solve.base.solution import SolveInput
from service.solve.height.direct_light import LARGEST_ALBEDO
from service.solve.height.height import integrate, projection_of
from service.solve.height.interreflection import ArrivingLight, arriving_light
from stage.capture.lighting import ExtendedLights
from stage.colour.colour import GREY_WEIGHTS
from stage.transforms import fibonacci_sphere

PLACES = 512
"""Places, over the whole sphere, to which lines of sight are followed: 9° apart, a third of a usual source."""
STEEPEST = -0.9
"""Least z of a place: light from straight behind reaches no surface that the camera sees."""
PIXELS_AT_ONCE = 4096
"""Pixels whose reflection of every place is held at one time, some tens of megabytes."""
LEAST_CHANGE = 0.002
"""Part of the light of a pixel, taken by shadows or added by interreflection, below which the pixel is left as it is: the tables of
responses are no more exact."""
LEAST_FACING = 0.02
"""Least n·v that is used."""


class OpenSources(NamedTuple):
    """The parts of sources that pixels of an object see, and the light that the object throws on itself."""

    touched: np.ndarray  # [n] ascending positions of the pixels whose light changes
    part: np.ndarray  # [n, lights] uint8: visible part of each source at these pixels, 255 for all
    change: np.ndarray  # [n] float32: light that the object takes away and adds, over the light that all sources would give
    albedo: np.ndarray  # [n, 3] float32 of all light that they send on, whatever its direction
    arriving: ArrivingLight | None
    lights: Lights
    width: int
    """Pixels of a row of the image."""

    @property
    def found(self) -> tuple[object, ...]:
        """Return what was found about the whole object, by which workers compare what they have."""
        return self.touched, self.part, self.change, self.albedo, self.arriving

    @property
    def given_share(self) -> np.ndarray:
        """Return [n] the share of the sources that leave a touched pixel a reading."""
        return np.maximum((self.part >= 255 * LEAST_PART).mean(axis=1), 1 / self.part.shape[1])

    def keep(self, pixels: np.ndarray, samples: Samples) -> None:
        """Subtract from readings, in place, what the object threw on itself, and divide them by the visible part of their source; those of
        pixels that are not touched stay."""
        row = np.minimum(np.searchsorted(self.touched, pixels), len(self.touched) - 1)
        changed = self.touched[row] == pixels
        if self.arriving is not None:
            corners, shares = self.arriving.at(*np.divmod(pixels, self.width))
            albedo = np.where(changed[:, None], self.albedo[row], 0)
            subtract_bounce(samples, self.arriving.light, corners, shares, albedo, channel_weights(self.lights, GREY_WEIGHTS))
        divide_by_visible(samples, np.where(changed[:, None], self.part[row] / np.float32(255), 1))


def open_sources(given: SolveInput, lights: ExtendedLights, padded: Lights, status: np.ndarray, found: Found,
                 view: View) -> OpenSources | None:
    """Find what the object does to its own light, or return None when it does nothing to any pixel.
    `padded`: the lights, padded, with their irradiance. `status`: [pixels] of kernels.status. `found`: normals and materials of all
    pixels of the image."""
    solved = (status == Status.OK).reshape(given.mask.shape)
    surface = integrate(given, np.ascontiguousarray(found.normal.T), solved, stage="surface")
    if surface is None:
        return None
    place = fibonacci_sphere(PLACES)
    share = np.zeros((PLACES, len(lights.irradiance)), np.float32)
    np.add.at(share, ((lights.direction @ place.T).argmax(axis=1), lights.light), lights.share)
    kept = share.any(axis=1) & (place[:, 2] > STEEPEST)
    place, share = place[kept], share[kept]
    arriving = arriving_light(given, padded, np.ascontiguousarray(found.normal.T), surface.height, solved)
    on_device = wp.array(solved.astype(np.uint8), dtype=wp.uint8, device=given.device)
    pixels, weights = np.flatnonzero(solved), channel_weights(padded, GREY_WEIGHTS)
    touched, parts, changes, albedos = [], [], [], []
    for first in range(0, len(pixels), PIXELS_AT_ONCE):
        some = pixels[first : first + PIXELS_AT_ONCE]
        visible = to_numpy(see_lights(np.pad(place, ((0, 0), (0, 1))), some, surface.height, on_device, projection_of(given.camera),
                             device=given.device)).reshape(len(place), -1)[:, : len(some)].T > 0
        reflected = _reflected(Found(*(values[some] for values in found)), view(some), place, weights)
        whole, seen = reflected @ share, (reflected * visible) @ share
        rough = np.where(found.roughness[some] >= SHARP, 1, 0)[:, None]  # a mirror sends its light to one side
        albedo = np.minimum(found.diffuse_albedo[some] + rough * found.specular[some], LARGEST_ALBEDO).astype(np.float32)
        bounced = np.zeros(len(some))
        if arriving is not None:
            corners, corner_shares = arriving.at(*np.divmod(some, given.camera.width))
            total = arriving.light.sum(axis=2)[corners]  # [n, 4, 3]
            bounced = np.einsum("nk,nkc,nc->n", corner_shares, total, albedo * weights)
        change = ((whole - seen).sum(axis=1) + bounced) / np.maximum(whole.sum(axis=1), 1e-12)
        changed = change > LEAST_CHANGE
        touched.append(some[changed])
        changes.append(change[changed].astype(np.float32))
        parts.append(np.round(255 * np.divide(seen, whole, out=np.ones_like(whole), where=whole > 0))[changed].astype(np.uint8))
        albedos.append(albedo[changed])
    if not any(map(len, touched)):
        return None
    return OpenSources(np.concatenate(touched), np.concatenate(parts), np.concatenate(changes), np.concatenate(albedos), arriving, padded,
                       given.camera.width)


def _reflected(found: Found, view: np.ndarray, place: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [n, places] float32 the grey radiance of pixels under each place of irradiance one: Lambert's lobe, and a GGX lobe that is as
    wide as places are apart."""
    place = place.astype(np.float32)
    normal, rough = found.normal.astype(np.float32), found.roughness.astype(np.float32)[:, None]
    albedo, f0 = ((values.astype(np.float32) @ weights.astype(np.float32))[:, None] for values in (found.diffuse_albedo, found.specular))
    toward_light = np.maximum(normal @ place.T, 0)
    toward_viewer = np.maximum((normal * view).sum(axis=1), LEAST_FACING)[:, None]
    across = np.maximum(0.5 * (1 + view @ place.T), 1e-4)  # (v·h)²
    halfway = ((normal @ place.T) + (normal * view).sum(axis=1)[:, None]) / (2 * np.sqrt(across))
    square = np.minimum(rough**4 + 0.5 / PLACES / np.sqrt(across), 1)  # a disc of solid angle Ω widens α² by Ω / (8π v·h)
    spread = np.maximum(halfway**2 * (square - 1) + 1, 1e-6)
    masking = (toward_light * np.sqrt(toward_viewer**2 * (1 - square) + square)
               + toward_viewer * np.sqrt(toward_light**2 * (1 - square) + square))
    lobe = 0.5 / math.pi * square * toward_light / (spread**2 * np.maximum(masking, 1e-9))
    rise = (1 - np.sqrt(across)) ** 5
    shines = np.where(rough > 0, f0 + (1 - f0) * rise, 0)
    return np.asarray(albedo / math.pi * toward_light + shines * lobe, dtype=np.float32)
