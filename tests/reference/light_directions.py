"""The least error that directions of distant lights can have, by the Cramér-Rao bound, from images of Lambertian pixels and a rough table.

Van Trees, "Detection, Estimation and Modulation Theory", part I, 1968, section 2.4: the information of the images and of what is known
before add up.
"""

import numpy as np

from tests.reference.sampling import lattice


def least_error_degrees(count: int, *, table_degrees: float, strength: float, noise: float = 0.005, pixels: int = 300,
                        seed: int = 0) -> float:
    """Root mean square angle, degrees, that is left of independent errors of a table.

    Args:
        count: lights, spread over 55° about the view axis.
        table_degrees: root mean square error of the table.
        strength: standard deviation of the logarithms of the irradiances, as far as they are known.
        noise: of a reading, over that of an albedo of 1.
        pixels: of free albedo and normal.
        seed: of the object.
    """
    random = np.random.default_rng(seed)
    lights = lattice(count, 55)
    first = np.cross(lights, (0, 1, 0.1))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    moves = np.stack([first, np.cross(lights, first), lights], axis=1)  # what two angles and the logarithm of the strength change
    normals = random.normal(size=(8 * pixels, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    surface = normals[normals[:, 2] > 0.5][:pixels] * random.uniform(0.3, 0.9, (pixels, 1))
    information = np.zeros((3 * count, 3 * count))
    for own in surface:
        lit = lights @ own > 0
        change = np.zeros((count, 3 * count))
        for light in np.flatnonzero(lit):
            change[light, 3 * light:3 * light + 3] = moves[light] @ own
        seen = lights * lit[:, None]
        free = np.eye(count) - seen @ np.linalg.pinv(seen)  # what no normal and albedo of the pixel explain
        information += change.T @ free @ change / noise**2
    before = np.tile([1 / np.radians(table_degrees / 2**0.5) ** 2] * 2 + [1 / strength**2], count)
    left = np.diag(np.linalg.inv(information + np.diag(before)))
    return float(np.degrees(np.sqrt((left[0::3] + left[1::3]).mean())))
