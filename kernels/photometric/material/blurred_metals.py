"""Metals of which no pixel shows the lobe of one normal: found by the moments of their readings.

Where a polished metal turns by many degrees within a pixel, or mirrors other parts, no single lobe fits its readings. A robust fit then
leaves out the bright ones, which are few, and takes the metal for a dark dielectric. Yet all its light is highlight: the mean of the half
vectors, weighted by the readings, is its normal, the sum of the readings its F0, and how far they spread its roughness, which holds the
turn of the surface within the pixel too, as the pixel shows it.

Source: the centroid of a lobe after Ma, Hawkins, Peers, Chabert, Weiss and Debevec, "Rapid acquisition of specular and diffuse normal maps
from polarized spherical gradient illumination", EGSR 2007, here of half vectors, and robust by mean shift (Comaniciu and Meer, "Mean
shift", TPAMI 2002); the energy of a blurred lobe after Olano and Baker, "LEAN mapping", I3D 2010.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.material.metal_energy import bare_lobe
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.samples import Samples, host_vectors, to_host

LEAST_LIGHTS = 32
"""Fewest lights whose half vectors have a mean: among sixteen a highlight falls on one or none."""
POWER, REACH_DEGREES, ROUNDS = 1.5, 25.0, 8
"""The weight of a half vector is this power of its reading, and falls with its angle from the mean as a Gaussian with this reach; number of
rounds."""
ROUGHNESS = np.linspace(0.1, 0.9, 17)
"""Roughness that is tried."""
DEGREES_PER_MISREAD = 30.0
"""Standard error of the normal in degrees where all light is misread: on eleven captures of five path-traced objects under 32 to 128 lights
error/σ is 0.45 in the median and 2.2 at the 95th percentile."""
WIDENED = 0.5
"""Part of the standard error of the normal, in radians, by which the width α of a lobe grows, in quadrature: a narrow one that is off
shines under the wrong light."""


class BlurredMetals(NamedTuple):
    """The metal of each sampled pixel, if it is one."""

    normal: np.ndarray  # [n, 3] float32, unit
    specular: np.ndarray  # [n, 3] float32, F0
    roughness: np.ndarray  # [n] float32
    misread: np.ndarray  # [n] share of the light, as of lost_light.misread_light
    sigma: np.ndarray  # [n] float32, standard error of the normal, degrees


def find_blurred_metals(samples: Samples) -> BlurredMetals:
    """Return the metal that the moments of the readings of sampled pixels make; waits for the device.
    `samples`: of LEAST_LIGHTS lights or more of one direction each."""
    colour = np.maximum(host_vectors(samples, samples.colour), 0).astype(np.float64)  # 0: no reading
    toward = host_vectors(samples, samples.toward).astype(np.float64)
    view, grey = to_host(samples, samples.view).astype(np.float64), colour.mean(axis=0)
    half = np.moveaxis(toward, 0, 2) + view[:, None]
    half /= np.maximum(np.linalg.norm(half, axis=2, keepdims=True), 1e-6)
    strength = grey**POWER
    normal = _mean(half, strength)
    for _ in range(ROUNDS):
        apart = np.arccos(np.clip(np.einsum("nlc,nc->nl", half, normal), -1, 1))
        normal = _mean(half, strength * np.exp(-((apart / np.radians(REACH_DEGREES)) ** 2)))
    least, misread, roughness = np.full(len(normal), np.inf), np.ones(len(normal)), np.zeros(len(normal))
    specular = np.zeros((len(normal), 3))
    for trial in ROUGHNESS:
        lobe, rise = bare_lobe(normal, toward, view, float(trial))
        risen, level = (lobe * rise).sum(axis=1), (lobe * (1 - rise)).sum(axis=1)
        f0 = np.clip((colour.sum(axis=2) - risen) / np.maximum(level, 1e-12), 0, 1).T
        mean = f0.mean(axis=1, keepdims=True)
        off = grey - lobe * (mean + (1 - mean) * rise)
        less = (squares := (off**2).sum(axis=1)) < least
        least[less], roughness[less], specular[less] = squares[less], trial, f0[less]
        misread[less] = np.abs(off[less]).sum(axis=1) / np.maximum(grey[less].sum(axis=1), 1e-12)
    sigma = np.minimum(DEGREES_PER_MISREAD * misread, LARGEST_ERROR)
    roughness = (roughness**4 + (WIDENED * np.radians(sigma)) ** 2) ** 0.25
    return BlurredMetals(*(values.astype(np.float32) for values in (normal, specular, roughness, misread, sigma)))


def _mean(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the unit means [n, 3] of directions [n, lights, 3]."""
    mean = np.einsum("nl,nlc->nc", weights, directions)
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12))
