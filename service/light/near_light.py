"""Point lights and area lights near the object, as samples for a model of the surface."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.relight import sources
from kernels.relight.sources import Sources, far, grouped, join
from service.requests.near_lights import PointLight, RectangleLight, SphereLight

NEAR_MARCHES = 48
"""Number of places on an area light to which shadows are marched: its penumbra has steps of 2 %."""
ANYWHERE = 1e30
"""Reach beyond every scene: each sample of an area light takes the nearest marched place."""

NearLight = PointLight | SphereLight | RectangleLight


class NearLights(NamedTuple):
    """Near lights as samples."""

    fine: Sources
    """Samples for a model of the surface, with rows of visibility."""
    coarse: Sources
    """Fewer samples, for sums of captured images."""
    marched: np.ndarray  # [rows, 4] places of the rows of visibility


def near_lights(lights: Sequence[NearLight], first_row: int) -> NearLights:
    """Return near lights as samples.

    Args:
        lights: in the camera frame; any number.
        first_row: the first row of visibility that is theirs.
    """
    nothing = far(np.zeros((0, 3)), np.zeros((0, 3)))
    fine, coarse, marched = [nothing], [nothing], [np.zeros((0, 4), np.float32)]
    for light in lights:
        all_samples = _near_samples(light)
        samples, places = grouped(all_samples, np.ones(all_samples.count, dtype=bool), first_row, most=NEAR_MARCHES, reach=ANYWHERE)
        first_row += len(places)
        fine.append(samples)
        coarse.append(_near_samples(light, sources.FEW))
        marched.append(places)
    return NearLights(join(fine), join(coarse), np.concatenate(marched))


def _near_samples(light: NearLight, count: int | None = None) -> Sources:
    if isinstance(light, SphereLight):
        return sources.sphere(np.array(light.center_m), light.radius_m, np.array(light.radiance), count or sources.SPHERE_SAMPLES)
    if isinstance(light, RectangleLight):
        return sources.rectangle(np.array(light.center_m), np.array(light.edge_u_m), np.array(light.edge_v_m), np.array(light.radiance),
                                 count or sources.RECTANGLE_SAMPLES)
    axis = None if light.axis is None else np.array(light.axis) / np.linalg.norm(light.axis)
    return sources.point(np.array(light.position_m), np.array(light.intensity), axis, light.anisotropy)
