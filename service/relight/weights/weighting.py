"""Light of an environment, of discs or of samples → energies and weights of the captured lights.

Light is shared out over the captured lights by one of three weightings: `kernel` has the least expected error of the frame; with `cells`,
shadows and highlights are as sharp as a light's own, and a moving sun steps from light to light; with `smooth`, and with `kernel`, it fades
from light to light, and with `smooth` shadows of three lights show at once. The weight of a light of irradiance E is the energy that it was
given divided by E. Few samples are shared out in NumPy, because they are too few for a launch.

Source: Debevec et al., SIGGRAPH 2000, section 3.3.
"""

import math
from collections.abc import Iterator

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.directions.latlong import SampleGrid, check, first_of_equals
from kernels.relight.model.sources import disc_samples
from kernels.relight.weights.borders import Shares
from kernels.relight.weights.cells import integrate_cells
from kernels.relight.weights.smooth import locate
from kernels.relight.weights.turned_sums import LightEnergy, gather
from service.relight.weights.quadrature import integrate_kernel, share_kernel
from service.relight.weights.triangulation import share_smooth, triangles_between
from service.requests.relight import LightWeights


def integrate(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray, *, weighting: LightWeights,
              device: str) -> np.ndarray:
    """Share a lat-long map out over the lights, for several rotations of the map.

    Args:
        environment: [rows, cols, 3] scene-linear radiance; top row +y, image centre +z, a quarter from the left +x.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).
        rotations: [frames, 3, 3]: the environment is turned by these, turned = rotation @ direction.
        device: where nearest lights or triangles are found; sums are taken on the host in float64.

    Returns:
        [frames, lights, 3] float64 energy of each light; it sums to that of the whole map.

    Raises:
        ArrayError: as latlong.check; for smooth weighting also as triangulate_sphere.
    """
    if weighting is LightWeights.KERNEL:
        return integrate_kernel(environment, directions, rotations)
    chosen = {LightWeights.CELLS: integrate_cells, LightWeights.SMOOTH: integrate_smooth}[weighting]
    return chosen(environment, directions, rotations, device=device).energy


def integrate_smooth(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray, *, device: str) -> LightEnergy:
    """Share a lat-long map out over the lights, each direction to the three around it; arguments are those of `integrate`.
    Returns energy of each light, and the integral of its share over the sphere; both sum to those of the whole map. Of lights in one
    place the first gets all. Where lights are missing, energy goes to those around the hole (service.relight.weights.triangulation)."""
    directions, rotations = check(environment, directions, rotations)
    kept, triangles = first_of_equals(directions), triangles_between(directions)

    def split(rotation: np.ndarray, band: SampleGrid) -> Iterator[Shares]:
        face, share = locate(band, triangles, rotation, device=device)
        for k in range(3):
            yield Shares(slice(None), triangles.corner[face, k], share[:, k])

    sums = gather(environment, rotations, len(triangles.vertex), split)
    energy = np.zeros((len(rotations), len(directions), 3))
    solid_angle = np.zeros((len(rotations), len(directions)))
    energy[:, kept] = np.einsum("fvc,vl->flc", sums.energy, triangles.share)
    solid_angle[:, kept] = sums.solid_angle @ triangles.share
    return LightEnergy(energy, solid_angle)


def share_samples(samples: np.ndarray, energy: np.ndarray, directions: np.ndarray, *, weighting: LightWeights) -> np.ndarray:
    """Share the energy of samples out over the captured lights, as whole environments are.

    Args:
        samples: [n, 3] unit vectors to the samples.
        energy: [n, channels] of each.
        directions: [lights, 3] unit vectors to the lights; of several in one place the first gets all.

    Returns:
        [lights, channels] float64; its sum is that of the samples.
    """
    if weighting is LightWeights.KERNEL:
        return share_kernel(samples, energy, directions)
    kept = first_of_equals(directions)
    given = np.zeros((len(directions), energy.shape[1]))
    if weighting is LightWeights.SMOOTH:
        given[kept] = share_smooth(samples, energy, directions[kept])
        return given
    nearest = (samples @ directions[kept].T).argmax(axis=1)
    for channel, amount in enumerate(energy.T):
        given[kept, channel] = np.bincount(nearest, weights=amount, minlength=len(kept))
    return given


def integrate_discs(middles: np.ndarray, angles_degrees: np.ndarray, directions: np.ndarray, *, weighting: LightWeights) -> np.ndarray:
    """Share discs of even radiance out over the lights.

    Args:
        middles: [discs, 3] unit vectors to the middle of each disc.
        angles_degrees: [discs] diameter of each as seen from the object, 0…180.
        directions: [lights, 3] unit vectors from the object to the lights (without padding).

    Returns:
        [discs, lights] float64: ∫ w L dω, for discs that give a surface facing them an irradiance of 1: ∫ L cosθ dω = 1, so that the
        sum over the lights, ∫ L dω, is 2 / (1 + cos(angle / 2)): 1 for a small disc, 2 for half the sphere.

    Raises:
        ArrayError: shapes that do not fit; for smooth weighting also as triangulate_sphere.
    """
    middles, directions = np.asarray(middles, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or len(directions) == 0:
        raise ArrayError(f"directions are {directions.shape}: give [lights, 3], one light or more")
    if middles.ndim != 2 or middles.shape[1] != 3 or np.shape(angles_degrees) != (len(middles),):
        raise ArrayError(f"middles are {middles.shape}, angles {np.shape(angles_degrees)}: give [discs, 3] and [discs]")
    energy = np.zeros((len(middles), len(directions)))
    for disc, (middle, angle) in enumerate(zip(middles, angles_degrees, strict=True)):
        samples = disc_samples(middle, float(angle))
        shares = share_samples(samples, np.ones((len(samples), 1)), directions, weighting=weighting)[:, 0]
        energy[disc] = shares * (2 / (1 + math.cos(math.radians(angle / 2))) / len(samples))
    return energy


def light_weights(energy: np.ndarray, irradiance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return [frames, 3, lights padded] float32 weights of the stored images with which their sum is lit by the environment.

    Args:
        energy: [frames, lights, 3] of each light, of `integrate`.
        irradiance: [lights, 3] of each captured light, without padding.
        scale: [lights padded] radiance of a stored 1.0.

    Raises:
        ArrayError: a light gives nothing in a channel, so that its part of the energy there could not be placed.
    """
    dark = np.argwhere(irradiance <= 0)
    if len(dark):
        light, channel = dark[0]
        raise ArrayError(f"irradiance of light {light} is 0 in channel {'RGB'[channel]}: "
                         "its part of the environment would stay dark in it")
    frames, lights, _ = energy.shape
    weights = np.zeros((frames, 3, len(scale)), dtype=np.float32)
    weights[:, :, :lights] = np.swapaxes(energy / irradiance, 1, 2) * scale[:lights]
    return weights
