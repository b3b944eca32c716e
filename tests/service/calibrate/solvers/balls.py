"""Cameras and balls that the calibration tests look at, beside the reference renderer's arguments for the same."""

import numpy as np

from stage.capture.camera import Camera

WIDTH, HEIGHT = 240, 160
ORTHOGRAPHIC = Camera(projection="orthographic", resolution=(WIDTH, HEIGHT), pixel_size_m=0.001)
PERSPECTIVE = Camera(projection="perspective", resolution=(WIDTH, HEIGHT), focal_px=(400.0, 400.0))

SCENES = {
    # 60 px ball, off the grid so that no symmetry helps
    "orthographic": (ORTHOGRAPHIC, {"centre": np.array([0.0123, -0.0071, 0.0]), "radius": 0.06, "pixel_size": 0.001}),
    # the same size, 6 degrees off the axis: its outline is an ellipse
    "perspective": (PERSPECTIVE, {"centre": np.array([0.08, -0.02, -0.8]), "radius": 0.12, "focal": 400.0}),
}


def box(image: np.ndarray, view) -> np.ndarray:
    """[h, w, 3] of a grey image over a view's box."""
    return np.repeat(image[view.box][..., None], 3, axis=-1)


def unit(*vector: float) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def spread(count: int, least_z: float) -> np.ndarray:
    """[count, 3] unit directions over the cap z > least_z, on a golden spiral."""
    z = least_z + (1 - least_z) * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=-1)
