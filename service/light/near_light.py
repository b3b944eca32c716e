"""Near lights as asked for → samples of light, and the places from which their shadows are marched."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.relight import sources
from kernels.relight.marching import grouped
from kernels.relight.sources import Sources, far, join
from service.requests.near_lights import PointLight, RectangleLight, SphereLight

MARCHES = 48
"""Places of an area light that shadows are marched from: a penumbra of 2 % steps."""
ANYWHERE = 1e30

NearLight = PointLight | SphereLight | RectangleLight


class NearLights(NamedTuple):
    """Near lights, ready to light a surface."""

    fine: Sources
    """For a model of the surface, with rows of visibility."""
    coarse: Sources
    """For sums of captured images."""
    marched: np.ndarray  # [rows, 4] places of the rows of visibility


def near_lights(lights: Sequence[NearLight], first_row: int) -> NearLights:
    """Sample near lights.

    Args:
        lights: any number.
        first_row: of visibility that is theirs.
    """
    nothing = far(np.zeros((0, 3)), np.zeros((0, 3)))
    fine, coarse, marched = [nothing], [nothing], [np.zeros((0, 4), np.float32)]
    for light in lights:
        samples, places = grouped(_samples(light), np.ones(_samples(light).count, dtype=bool), first_row, most=MARCHES, reach=ANYWHERE)
        first_row += len(places)
        fine.append(samples)
        coarse.append(_samples(light, sources.FEW))
        marched.append(places)
    return NearLights(join(fine), join(coarse), np.concatenate(marched))


def _samples(light: NearLight, count: int | None = None) -> Sources:
    if isinstance(light, SphereLight):
        return sources.sphere(np.array(light.center_m), light.radius_m, np.array(light.radiance), count or sources.SPHERE_SAMPLES)
    if isinstance(light, RectangleLight):
        return sources.rectangle(np.array(light.center_m), np.array(light.edge_u_m), np.array(light.edge_v_m), np.array(light.radiance),
                                 count or sources.RECTANGLE_SAMPLES)
    axis = None if light.axis is None else np.array(light.axis) / np.linalg.norm(light.axis)
    return sources.point(np.array(light.position_m), np.array(light.intensity), axis, light.anisotropy)
