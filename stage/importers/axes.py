"""The axes of a table of directions or positions, as seen by the camera, and their conversion to the camera frame."""

import numpy as np

from stage.errors import ManifestError

WAYS: dict[str, tuple[int, int, int]] = {"right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0),
                                         "towards": (0, 0, 1), "away": (0, 0, -1)}
"""Where an axis points as seen by the camera → its unit vector in the camera frame; `away` is where the camera looks."""

Axes = tuple[str, str, str]
"""Where x, y and z of a table point, each one of WAYS."""
CAMERA: Axes = ("right", "up", "towards")
"""The axes of the camera frame, which OpenGL has too."""
OPENCV: Axes = ("right", "down", "away")


def camera_from_table(axes: Axes) -> np.ndarray:
    """Return the matrix that takes vectors of a table to the camera frame.

    Returns:
        [3, 3] float64 for column vectors; it mirrors when the axes are left-handed.

    Raises:
        ManifestError: two axes lie on one line.
    """
    matrix = np.array([WAYS[way] for way in axes], dtype=np.float64).T
    if np.linalg.matrix_rank(matrix) < 3:
        raise ManifestError(f"--axes {','.join(axes)}: two of them lie on one line: give one of right, left, one of up, down and one of "
                         "towards, away")
    return matrix


def describe(axes: Axes) -> str:
    """Return the axes as words: `x right, y down, z away from the camera (right-handed)`."""
    words = {"towards": "towards the camera", "away": "away from the camera"}
    hand = "right" if np.linalg.det(camera_from_table(axes)) > 0 else "left"
    return ", ".join(f"{name} {words.get(way, way)}" for name, way in zip("xyz", axes, strict=True)) + f" ({hand}-handed)"
