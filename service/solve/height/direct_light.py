"""The direct light of every reading: what the object itself does to the light of a lamp is taken out.

From the first normals follows a height, from the height which readings lie in cast shadow, and from the height and the images the light
that the object throws on itself.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import Lights, channel_weights
from kernels.photometric.model.samples import Samples
from kernels.photometric.shadows.bounce import subtract_bounce
from kernels.photometric.shadows.shadowing import exclude_shadows
from kernels.surface.shadows import Extent, extent_of
from service.solve.base.solution import SolveInput
from service.solve.height.height import QUICK, integrate, projection_of
from service.solve.height.interreflection import ArrivingLight, arriving_light
from service.solve.height.part_scene import Material
from service.solve.height.parts import numbered, place_parts
from stage.colour.colour import GREY_WEIGHTS

LARGEST_ALBEDO = 0.98
"""The part of light that a surface can send on; a fitted albedo may be larger where the scale of the lights is not absolute."""


class DirectLight(NamedTuple):
    """Shadows and interreflection of an object, to be taken out of readings."""

    given: SolveInput
    lights: Lights
    field: NearField | None
    """The positions of the lights; None where all lights are distant."""
    solved: wp.array  # [rows, cols] uint8 on the device: the number of the part of each solved pixel, 0 elsewhere
    height: wp.array  # [rows, cols] float32, on the device
    extent: Extent
    """The part of the image where there is surface, and its highest z."""
    shadows: bool
    """True if cast shadows of the height are taken out."""
    arriving: ArrivingLight | None
    """None: no interreflection is taken out."""
    albedo: np.ndarray  # [3, pixels] of the light that other surfaces send, at the normals from which all this follows
    albedo_scale: float = 1.0
    """Light that other surfaces send over that which this albedo and the form factors give: albedo is relative where the scale of the
    lights is, and gloss and surfaces out of sight send light too."""

    @property
    def found(self) -> tuple[object, ...]:
        """Return what was found about the whole object, by which workers compare what they have."""
        return self.solved, self.height, self.shadows, self.arriving, self.albedo, self.albedo_scale

    def on(self, device: str) -> "DirectLight":
        """Return the same for readings on a device, to which it is uploaded once."""
        arriving = self.arriving
        if arriving is not None:
            arriving = arriving._replace(light=wp.array(arriving.light, dtype=wp.float32, device=device))
        if device == self.given.device:
            return self._replace(arriving=arriving)
        solved, height = (wp.array(to_numpy(plane), dtype=plane.dtype, device=device) for plane in (self.solved, self.height))
        return self._replace(solved=solved, height=height, arriving=arriving)

    def with_more(self, light: np.ndarray) -> "DirectLight":
        """Return the same with more light that arrives, [patches, 3, lights]."""
        assert self.arriving is not None
        return self._replace(arriving=self.arriving._replace(light=self.arriving.light + light))

    def keep(self, pixels: np.ndarray, samples: Samples) -> None:
        """Change readings in place: mark those in cast shadow as none, and subtract the light that the object threw on itself from the
        others."""
        if self.shadows:
            exclude_shadows(samples, pixels, self.height, self.solved, projection_of(self.given.camera),
                            None if self.field is None else self.field.places, self.extent)
        if self.arriving is not None:
            corners, shares = self.arriving.at(*np.divmod(pixels, self.given.camera.width))
            albedo = np.minimum(self.albedo_scale * self.albedo[:, pixels].T.astype(np.float32), LARGEST_ALBEDO)
            subtract_bounce(samples, self.arriving.light, corners, shares, albedo, channel_weights(self.lights, GREY_WEIGHTS),
                            None if self.field is None else self.field.at(pixels))

    def under(self, lights: Lights, factor: np.ndarray) -> "DirectLight":
        """Return the same under the same lights of another irradiance, which is that so far times `factor` [lights]."""
        arriving = self.arriving
        if arriving is not None:
            arriving = arriving._replace(light=(arriving.light / factor).astype(np.float32))
        return self._replace(lights=lights, arriving=arriving)


def direct_light(given: SolveInput, lights: Lights, field: NearField | None, normal: np.ndarray, material: Material,
                 bouncing: np.ndarray, solved: np.ndarray, *, shadows: bool, interreflection: bool, parts: bool) -> DirectLight | None:
    """Find what the object does to its own light, or return None when no pixel is solved.
    `normal`: [3, pixels] float32, found so far. `bouncing`: [3, pixels] albedo of the light that other surfaces send. `parts`: whether
    parts are moved in depth to where their shadows agree with the images; not under near lights."""
    whole = partial(integrate, given, normal, solved, specular=material.specular, options=QUICK, stage="surface")
    surface = whole()
    if surface is None:
        return None
    height = surface.height
    if parts and field is None:
        surface, placed = place_parts(given, lights, normal, material, surface, to_numpy(height), whole)
        height = wp.array(placed.height, dtype=float, device=given.device)
    part = surface.part
    mask = solved.astype(np.uint8) if part is None else numbered(part)  # a pixel may be solved and of no part
    arriving = arriving_light(given, lights, normal, height, mask > 0) if interreflection else None
    on_device = wp.array(mask, dtype=wp.uint8, device=given.device)
    return DirectLight(given, lights, field, on_device, height, extent_of(to_numpy(height), mask), shadows, arriving, bouncing)
