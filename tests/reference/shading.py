"""Slow float64 twins of lighting solved maps: the contract's material under samples of light, sums of captured images for near light, and
the trust in a model; and Lambert's formula for the irradiance of a polygon. They import nothing of ours but other references."""

from typing import NamedTuple

import numpy as np

from tests.reference.microfacet import diffuse, specular
from tests.reference.relight import shares_among


class Pixels(NamedTuple):
    """Solved maps at some pixels."""

    normal: np.ndarray  # [P, 3]
    albedo: np.ndarray  # [P, 3]
    f0: np.ndarray  # [P, 3]
    roughness: np.ndarray  # [P]; 0: no specular lobe
    view: np.ndarray  # [P, 3]
    position: np.ndarray  # [P, 3]

    def double(self) -> "Pixels":
        return Pixels(*(np.asarray(plane, dtype=np.float64) for plane in self))


def response(pixels, direction):
    """Diffuse and specular reading, BRDF · n·l, [P, 3] each, of unit directions [P, 3] or [3]; roughness² is GGX's alpha."""
    direction = np.broadcast_to(direction, pixels.normal.shape)
    matt = pixels.albedo * diffuse(pixels.normal, direction, pixels.view)[:, None]
    shiny = pixels.roughness > 0
    alpha = np.where(shiny, pixels.roughness, 1.0) ** 2
    lobe = np.stack([specular(pixels.normal, direction, pixels.view, alpha, pixels.f0[:, c]) for c in range(3)], axis=1)
    return matt, np.where(shiny[:, None], lobe, 0.0)


def arrival(position, place, axis):
    """Unit directions [P, 3] to a sample of light, and what of its energy arrives [P]: 1 of a far one, cos^μ / d² of a near one."""
    if place[3] == 0:
        return np.broadcast_to(place[:3], position.shape), np.ones(len(position))
    way = place[:3] - position
    distance = np.linalg.norm(way, axis=1)
    direction = way / distance[:, None]
    strength = 1 / distance**2
    if axis[3] > 0:
        strength = strength * np.maximum(-(direction @ axis[:3]), 0) ** axis[3]
    return direction, strength


def visibility(occluder, share, visible, count):
    """[P] of one sample: Σ share · row / 255, a row below 0 hides nothing, and a sample with none is all there."""
    if max(occluder) < 0:
        return np.ones(count)
    rows = [np.ones(count) if row < 0 else visible[row].astype(np.float64) / 255 for row in occluder]
    return sum(float(part) * row for part, row in zip(share, rows, strict=True))


def shade(pixels, sources, visible=None):
    """[6, P] radiance, diffuse and specular; visible [rows, P] 0…255."""
    pixels, total = pixels.double(), np.zeros((6, len(pixels.normal)))
    place, energy, axis = (np.asarray(plane, dtype=np.float64) for plane in sources[:3])
    for n in range(len(place)):
        direction, strength = arrival(pixels.position, place[n], axis[n])
        strength = strength * visibility(sources.occluder[n], sources.share[n], visible, len(strength))
        for first, part in zip((0, 3), response(pixels, direction), strict=True):
            total[first : first + 3] += (part * strength[:, None] * energy[n]).T
    return total


def parts(pixels, directions, visible=None):
    """[2, lights, 3, P] radiance / irradiance of the model under far lights, diffuse and specular."""
    pixels = pixels.double()
    far = np.asarray(directions, dtype=np.float64)
    both = np.stack([np.stack(response(pixels, direction)).swapaxes(1, 2) for direction in far], axis=1)
    return both if visible is None else both * (visible[:, None].astype(np.float64) / 255)


def readings(pixels, directions, visible=None):
    """[lights, 3, P] radiance / irradiance of the model under far lights."""
    return parts(pixels, directions, visible).sum(axis=0)


def shown(images, model, most=1.25):
    """What the specular parts of a model [2, lights, 3, P] are multiplied by to be as bright as images [lights, 3, P]: image / model."""
    whole = model.sum(axis=0)
    return np.where(whole > 1e-9, np.clip(images / np.where(whole > 1e-9, whole, 1), 0, most), 1)


def mean_shown(images, model, weight):
    """Its mean [3, P] over lights of weights [lights], each weighted by its specular part too; 1 where there is none."""
    weighted = np.maximum(weight, 0)[:, None, None] * model[1]
    gloss = weighted.sum(axis=0)
    return np.where(gloss > 1e-9, (weighted * shown(images, model)).sum(axis=0) / np.where(gloss > 1e-9, gloss, 1), 1)


def trust(images, model, neighbours, shares):
    """β [P]: the least-squares factor, held between 0 and 1, of what images [lights, 3, P] of readings miss when each is predicted by its
    neighbours, on what the model [2, lights, 3, P] says is missing when its specular parts are as bright as the images; lights without
    shares are left out. With it both, [lights, 3, P]."""
    missing, told = np.zeros(images.shape), np.zeros(images.shape)
    scaled = model[0] + shown(images, model) * model[1]
    for light, (near, share) in enumerate(zip(neighbours, shares, strict=True)):
        if sum(share) > 0:
            weight = np.zeros(len(images))
            np.add.at(weight, near, share)
            missing[light] = images[light] - np.tensordot(weight, images, 1)
            told[light] = model[0, light] + mean_shown(images, model, weight) * model[1, light] - np.tensordot(weight, scaled, 1)
    return np.clip((missing * told).sum(axis=(0, 1)) / (told**2).sum(axis=(0, 1)), 0, 1), missing, told


def sum_near(images, pixels, sources, lights):
    """[3, P] of images [lights, 3, P] of readings, each pixel's weighted by its own shares of what arrives; and those weights,
    [lights, 3, P]."""
    position = np.asarray(pixels.position, dtype=np.float64)
    weights, shares = np.zeros(images.shape), shares_among(lights)
    for place, energy, axis in zip(*(np.asarray(plane, dtype=np.float64) for plane in sources[:3]), strict=True):
        direction, strength = arrival(position, place, axis)
        weights += np.einsum("pl,p,c->lcp", shares(direction), strength, energy)
    return (weights * images).sum(axis=0), weights


def polygon_irradiance(corners, point, normal):
    """Of a polygon of radiance one, wholly above the horizon of the point, by Lambert's formula, Photometria 1760: half the sum over its
    edges of the angle that the edge spans, times the cosine between the normal and that of the plane through edge and point."""
    way = np.asarray(corners, dtype=np.float64) - point
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    assert (way @ normal > 0).all()
    following = np.roll(way, -1, axis=0)
    across = np.cross(way, following)
    angle = np.arctan2(np.linalg.norm(across, axis=1), (way * following).sum(axis=1))
    return abs((angle * (across / np.linalg.norm(across, axis=1, keepdims=True) @ normal)).sum()) / 2
