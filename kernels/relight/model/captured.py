"""The captured images of some pixels beside a model of their surface, under the same lights: what kernels compare."""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type
from kernels.relight.model.shading import Surface


class Captured(NamedTuple):
    """Captured images, the surface that they show, and the lights that lit them."""

    surface: Surface
    images: Any
    """A struct of images_type."""
    band: Band
    """The owner of the memory that the struct points to."""
    direction: np.ndarray  # [lights, 3] unit vectors to the captured lights
    irradiance: np.ndarray  # [lights, 3]

    @classmethod
    def of(cls, band: Band, surface: Surface, visible: wp.array, direction: np.ndarray, irradiance: np.ndarray,
           scale: np.ndarray) -> "Captured":
        """Put what kernels need on the device.

        Args:
            band: captured images of the same pixels as the surface.
            visible: [lights or more, P] uint8 packs of occlusion.see_lights for the captured lights.
            direction: [lights, 3] unit vectors to the captured lights.
            irradiance: [lights, 3] of each.
            scale: [lights padded] radiance of a stored 1.0.
        """
        band.require_channels(3)
        count, device = len(direction), surface.device
        if band.packs != surface.packs or visible.shape[1] != surface.packs or min(visible.shape[0], band.frame_count) < count:
            raise ArrayError(f"band has {band.packs} packs of {band.frame_count} lights, the surface {surface.packs}, visibility is "
                             f"{visible.shape}, directions are {count}: give the same pixels and lights")
        images = images_type(devices.pack_width(device))()
        images.stored, images.clipped, images.padded, images.surface = band.values, band.saturated, band.frame_count, surface.values
        images.visible = visible
        images.places = wp.array(np.concatenate([direction, np.zeros((count, 1))], axis=1), dtype=wp.vec4, device=device)
        factors = np.divide(scale[:count, None], irradiance, out=np.zeros((count, 3)), where=irradiance > 0)
        images.factors = wp.array(factors, dtype=wp.vec3, device=device)
        return cls(surface, images, band, direction, irradiance)

    def sums(self, kernel: Any, rows: int, *inputs: Any) -> wp.array:
        """Return [rows, pixels padded] float32 that a kernel, one thread for a pack, makes of the images and of further inputs."""
        device = self.surface.device
        sums = wp.empty((rows, self.surface.packs * devices.pack_width(device)), dtype=wp.float32, device=device)
        devices.launch(kernel(devices.pack_width(device)), self.surface.packs, [self.images, *inputs],
                       [as_packs(sums, device)], device=device)
        return sums


@once
def images_type(pack: int) -> Any:
    """Return the Warp struct of captured images and of a surface as packs of this length."""

    @wp.struct
    class Images:
        stored: wp.array2d(dtype=pack_type(pack, wp.float16))  # [3 · lights padded, P]
        clipped: wp.array2d(dtype=pack_type(pack, wp.uint8))  # [lights padded / 8, P] bits
        padded: int  # lights
        surface: wp.array2d(dtype=pack_type(pack, wp.float32))  # [24, P]
        visible: wp.array2d(dtype=pack_type(pack, wp.uint8))  # [lights or more, P]
        places: wp.array(dtype=wp.vec4)  # [lights] of far samples
        factors: wp.array(dtype=wp.vec3)  # [lights] stored → radiance / irradiance; 0 in channels without irradiance

    return Images
