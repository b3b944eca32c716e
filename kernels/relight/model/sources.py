"""Light as samples: far ones by direction, near ones by place, all in one form that the shading kernel takes.

A far sample is what an environment or a disc sends from about one direction; a near one is a point light or a patch of an area light.
Area lights become patches of equal area, each shining by the cosine to its normal.

To march to a light is to follow the line from a pixel towards it over the height map and look for surface that stands above the line
(kernels.surface.shadows). This takes most of the time of shading, so that samples can be put together in groups, and one march to the
middle of a group serves all its samples: a small bright light casts sharp shadows with few marches.

Source: one visibility for a cluster of lights, as in Dong, Grosch, Ritschel, Kautz and Seidel, "Real-time indirect illumination with
clustered visibility", VMV 2009.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError

SPHERE_SAMPLES = 512
"""Samples of a spherical light: half of them face away from any point, so that 256 light it."""
RECTANGLE_SAMPLES = 256
"""Samples of a rectangular light, as many as of a spherical light reach a point."""
DISC_PITCH_DEGREES = 1.0
"""Largest distance between two samples of a disc, degrees: finer than captured lights are apart."""
DISC_SAMPLES = 256
"""Least number of samples of a disc, so that a disc passes from one light to the next in steps of 0.4 % of its energy."""
FEW = 64
"""Samples of a light in model-guided sums. The images and the model are summed over the same samples and only the difference is used, so
that the error of few samples cancels."""
NEVER = -1
"""Occluder row of a sample that nothing hides."""


class Sources(NamedTuple):
    """Samples of light."""

    place: np.ndarray  # [n, 4] float32: unit direction to the light and 0, or its position in the camera frame and 1
    energy: np.ndarray  # [n, 3] float32: irradiance on a surface that faces it, or intensity per steradian; may be negative
    axis: np.ndarray  # [n, 4] float32: unit direction it shines along and exponent of the cosine about it; exponent 0: evenly
    occluder: np.ndarray  # [n, 3] int32 rows of visibility; NEVER: nothing hides it
    share: np.ndarray  # [n, 3] float32 of those rows

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.place)

    def taken(self, chosen: np.ndarray) -> "Sources":
        """Return some of the samples, by their numbers [m]."""
        return Sources(*(values[chosen] for values in self))

    def scaled(self, part: np.ndarray) -> "Sources":
        """Return the samples with a part [n] of their energy, without those that have none."""
        kept = part > 0
        chosen = Sources(*(values[kept] for values in self))
        return chosen._replace(energy=(chosen.energy * part[kept, None]).astype(np.float32))


def far(direction: np.ndarray, irradiance: np.ndarray) -> Sources:
    """Return far lights as samples: [n, 3] unit vectors to them, and [n, 3] irradiance on a surface that faces each."""
    return _sources(np.concatenate([direction, np.zeros((len(direction), 1))], axis=1), irradiance)


def point(position: np.ndarray, intensity: np.ndarray, axis: np.ndarray | None = None, exponent: float = 0.0) -> Sources:
    """Return one point light as a sample: irradiance = intensity · cos^exponent / distance², of the cosine about the axis.

    Args:
        position: [3] in the unit of the surface, camera frame.
        intensity: [3].
        axis: [3] unit direction it shines along; None: evenly.
    """
    lobe = None if axis is None else np.append(axis, exponent)[None]
    return _sources(np.append(position, 1.0)[None], np.asarray(intensity)[None], lobe)


def disc_samples(middle: np.ndarray, angle_degrees: float, count: int | None = None) -> np.ndarray:
    """Return [samples, 3] float64 unit vectors spread evenly over a disc on the sphere, each standing for the same solid angle.

    Args:
        angle_degrees: diameter, 0…180.
        count: of samples; None: DISC_SAMPLES, and more where they would be farther apart than DISC_PITCH_DEGREES.

    Source: Vogel, "A better way to construct the sunflower head", Mathematical Biosciences 44, 1979, with even steps of the cosine.
    """
    low = 2 * math.sin(math.radians(angle_degrees / 4)) ** 2  # 1 - cosine of the rim: without the rounding near 1
    if count is None:
        count = max(DISC_SAMPLES, math.ceil(2 * math.pi * low / math.radians(DISC_PITCH_DEGREES) ** 2))
    place = np.arange(count) + 0.5
    fall = place / count * low
    across = np.sqrt(fall * (2 - fall))
    turn = place * math.pi * (3 - math.sqrt(5))
    z = np.asarray(middle, dtype=np.float64)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return (across * np.cos(turn))[:, None] * x + (across * np.sin(turn))[:, None] * np.cross(z, x) + (1 - fall)[:, None] * z


def sphere(centre: np.ndarray, radius: float, radiance: np.ndarray, count: int = SPHERE_SAMPLES) -> Sources:
    """Return samples of a sphere of even radiance [3] around a centre [3] of the camera frame; the radius is in the same unit."""
    if not radius > 0:
        raise ArrayError(f"radius of a sphere light is {radius}: it must be above 0")
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    normal = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    area = 4 * math.pi * radius**2 / count
    return _patches(np.asarray(centre) + radius * normal, normal, np.asarray(radiance, dtype=np.float64) * area)


def rectangle(centre: np.ndarray, edge_u: np.ndarray, edge_v: np.ndarray, radiance: np.ndarray,
              count: int = RECTANGLE_SAMPLES) -> Sources:
    """Return about `count` samples of a rectangle of even radiance that shines against edge_u × edge_v, as a UsdLux RectLight does.

    The centre lies in the camera frame; the edges are whole and at a right angle.
    """
    edge_u, edge_v = np.asarray(edge_u, dtype=np.float64), np.asarray(edge_v, dtype=np.float64)
    lengths = np.linalg.norm(edge_u), np.linalg.norm(edge_v)
    if min(lengths) <= 0 or abs(edge_u @ edge_v) > 1e-3 * lengths[0] * lengths[1]:
        raise ArrayError(f"edges of a rectangle light are {edge_u.tolist()} and {edge_v.tolist()}: give two at a right angle")
    across = max(1, round(math.sqrt(count * lengths[0] / lengths[1])))
    down = max(1, round(count / across))
    u, v = np.meshgrid((np.arange(across) + 0.5) / across - 0.5, (np.arange(down) + 0.5) / down - 0.5)
    places = np.asarray(centre) + u.reshape(-1, 1) * edge_u + v.reshape(-1, 1) * edge_v
    normal = np.cross(edge_v, edge_u)
    area = lengths[0] * lengths[1] / len(places)
    return _patches(places, np.tile(normal / np.linalg.norm(normal), (len(places), 1)), np.asarray(radiance, dtype=np.float64) * area)


def join(parts: Sequence[Sources]) -> Sources:
    """Return all samples of some sources, in order."""
    return Sources(*(np.concatenate(planes) for planes in zip(*parts, strict=True)))


def own_rows(sources: Sources) -> Sources:
    """Return samples of which each is hidden as the row of visibility of its own says."""
    rows = np.full((sources.count, 3), NEVER, np.int32)
    rows[:, 0] = np.arange(sources.count)
    return sources._replace(occluder=rows, share=np.tile(np.float32([1, 0, 0]), (sources.count, 1)))


def grouped(sources: Sources, wanted: np.ndarray, first_row: int, *, most: int, reach: float) -> tuple[Sources, np.ndarray]:
    """Give samples the visibility of the group that they are in.

    Args:
        sources: all samples.
        wanted: [n] bool: which of them may be marched.
        first_row: of visibility, that the first group gets.
        most: groups.
        reach: how far a sample may be from the middle of its group, in the unit of places (of directions: radians).

    Returns:
        The samples, those near enough to a group with its row as their only occluder; and [groups, 4] the places of the groups. Middles
        are samples, chosen one after the other: the one whose energy times squared distance from all middles so far is largest.
    """
    chosen = np.flatnonzero(wanted)
    if not len(chosen):
        return sources, np.zeros((0, 4), np.float32)
    place = sources.place[chosen, :3].astype(np.float64)
    weight = np.abs(sources.energy[chosen]).sum(axis=1).astype(np.float64)
    middles = [int(np.argmax(weight))]
    distance = np.linalg.norm(place - place[middles[0]], axis=1)
    group = np.zeros(len(chosen), dtype=np.int32)
    while len(middles) < min(most, len(chosen)):
        farthest = int(np.argmax(weight * distance**2))
        if distance[farthest] == 0:
            break
        nearer = np.linalg.norm(place - place[farthest], axis=1)
        group[nearer < distance] = len(middles)
        distance = np.minimum(distance, nearer)
        middles.append(farthest)
    near = distance <= reach
    occluder, share = sources.occluder.copy(), sources.share.copy()
    occluder[chosen[near]] = np.stack([group[near] + first_row, *np.full((2, int(near.sum())), -1)], axis=1)
    share[chosen[near]] = (1, 0, 0)
    return sources._replace(occluder=occluder, share=share), sources.place[chosen[middles]]


def _patches(places: np.ndarray, normal: np.ndarray, intensity: np.ndarray) -> Sources:
    return _sources(np.concatenate([places, np.ones((len(places), 1))], axis=1), np.tile(intensity, (len(places), 1)),
                    np.concatenate([normal, np.ones((len(places), 1))], axis=1))


def _sources(place: np.ndarray, energy: np.ndarray, axis: np.ndarray | None = None) -> Sources:
    count = len(place)
    return Sources(place.astype(np.float32), np.asarray(energy, dtype=np.float32),
                   np.zeros((count, 4), np.float32) if axis is None else np.asarray(axis, dtype=np.float32),
                   np.full((count, 3), NEVER, np.int32), np.tile(np.float32([1, 0, 0]), (count, 1)))
