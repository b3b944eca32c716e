"""Functions of a light's direction whose weighted sum is a pixel: the biquadratic of polynomial texture maps, and hemispherical harmonics.

Convention:
    x right, y up, z towards the camera, as everywhere here and in RTI files; lights in front of the object, z > 0.
"""

import numpy as np

from kernels.errors import ArrayError

PTM_TERMS = 6
"""Number of functions of a polynomial texture map: u², v², u·v, u, v and 1."""
HSH_TERMS = (4, 9, 16)
"""Possible numbers of hemispherical harmonics: order n, from two to four, has n² functions."""
MIN_SPREAD = 1e-3
"""Least ratio of the smallest to the largest singular value of the functions over the lights: below, a coefficient holds a
thousand times the error of a reading."""


def biquadratic(directions: np.ndarray) -> np.ndarray:
    """Return the six terms of a polynomial texture map.

    Args:
        directions: [lights, 3] unit vectors to the lights.

    Returns:
        [lights, 6] float64: u², v², u·v, u, v, 1 with u = x, v = y.

    Source: Malzbender, Gelb and Wolters, "Polynomial Texture Maps", SIGGRAPH 2001.
    """
    u, v, _ = np.asarray(directions, dtype=np.float64).T
    return np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=1)


def hemispherical_harmonics(directions: np.ndarray, terms: int) -> np.ndarray:
    """Return functions that are orthonormal over the hemisphere.

    Args:
        directions: [lights, 3] unit vectors to the lights, z ≥ 0.
        terms: 4, 9 or 16.

    Returns:
        [lights, terms] float64, by order l and then by m. In order l the cosines come first, the highest m leading, and sines
        last: cos lφ … cos φ, 1, sin φ … sin lφ; functions of even m ≥ 2 carry a minus sign, as RTI files have them.

    Raises:
        ArrayError: another number of terms.

    Source: Gautron, Křivánek, Pattanaik and Bouatouch, "A Novel Hemispherical Basis for Accurate and Efficient Rendering", EGSR
        2004: associated Legendre polynomials of 2 cos θ − 1.
    """
    if terms not in HSH_TERMS:
        raise ArrayError(f"terms are {terms}: hemispherical harmonics have 4, 9 or 16")
    x, y, z = np.asarray(directions, dtype=np.float64).T
    azimuth, z = np.arctan2(y, x), np.clip(z, 0, 1)
    ring = np.sqrt(z - z * z)  # half the sine of the angle whose cosine is 2z − 1
    one = np.ones_like(z)
    cos, sin = (lambda m: np.cos(m * azimuth)), (lambda m: np.sin(m * azimuth))
    middle, steep = 2 * z - 1, 5 * z * z - 5 * z + 1
    functions = [
        np.sqrt(1 / (2 * np.pi)) * one,
        np.sqrt(6 / np.pi) * ring * cos(1),
        np.sqrt(3 / (2 * np.pi)) * middle,
        np.sqrt(6 / np.pi) * ring * sin(1),
        -np.sqrt(30 / np.pi) * ring**2 * cos(2),
        np.sqrt(30 / np.pi) * middle * ring * cos(1),
        np.sqrt(5 / (2 * np.pi)) * (6 * z * z - 6 * z + 1),
        np.sqrt(30 / np.pi) * middle * ring * sin(1),
        -np.sqrt(30 / np.pi) * ring**2 * sin(2),
        2 * np.sqrt(35 / np.pi) * ring**3 * cos(3),
        -np.sqrt(210 / np.pi) * middle * ring**2 * cos(2),
        2 * np.sqrt(21 / np.pi) * steep * ring * cos(1),
        np.sqrt(7 / (2 * np.pi)) * (20 * z**3 - 30 * z * z + 12 * z - 1),
        2 * np.sqrt(21 / np.pi) * steep * ring * sin(1),
        -np.sqrt(210 / np.pi) * middle * ring**2 * sin(2),
        2 * np.sqrt(35 / np.pi) * ring**3 * sin(3),
    ]
    return np.stack(functions[:terms], axis=1)


def fit_weights(functions: np.ndarray) -> np.ndarray:
    """Return the weight of each image with which their sum is a coefficient of the least-squares fit.

    Args:
        functions: [lights, terms].

    Returns:
        [terms, lights] float64.

    Raises:
        ArrayError: the lights do not determine the coefficients.
    """
    lights, terms = functions.shape
    strength = np.linalg.svd(functions, compute_uv=False)
    if lights < terms or strength[-1] < MIN_SPREAD * strength[0]:
        raise ArrayError(f"{lights} lights do not determine {terms} coefficients: spread more of them over the hemisphere")
    return np.linalg.pinv(functions)
