"""Surfaces that become .glb files: the usual ones, and those that break writers."""

import dataclasses

import numpy as np

from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_ball, make_sheet, make_wave

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))


def holes(size: int = 40) -> np.ndarray:
    """A mask with a ring, a hole of one pixel, a bridge of one pixel, a lone triangle and a lone pixel."""
    mask = np.zeros((size, size), dtype=bool)
    mask[4:20, 4:20] = True
    mask[8:14, 8:14], mask[16, 16] = False, False
    mask[12, 20:26] = True
    mask[10:16, 26:34] = True
    mask[30, 30] = mask[31, 30] = mask[31, 31] = True
    mask[37, 3] = True
    return mask


def metal_and_paint(**changes):
    """A ball whose right half is brass and whose left half is paint."""
    ball = make_ball(32, **changes)
    brass = ball.normal[..., 0] > 0
    return dataclasses.replace(
        ball, diffuse_albedo=np.where(brass[..., None], 0, np.array([0.3, 0.5, 0.2], np.float32)) * ball.mask[..., None],
        specular=np.where(brass[..., None], np.array([0.9, 0.7, 0.4], np.float32), np.float32(0.04)) * ball.mask[..., None])


SURFACES = {
    "everything": make_ball(), "metal and paint": metal_and_paint(), "ACEScg": metal_and_paint(color_space="lin_ap1_scene"),
    "other dielectric": make_ball(specular=np.full((24, 24, 3), 0.08, np.float32)),
    "diffuse only": make_ball(specular=None, roughness=None),
    "perspective height": make_wave("perspective", world_from_camera=POSE), "no scale": make_wave("orthographic"),
    "bow tie": make_sheet(np.array([[1, 0, 0], [1, 1, 1], [0, 0, 1]], dtype=bool)),
    "holes": make_sheet(holes(), diffuse_albedo=np.full((40, 40, 3), 0.5, np.float32), normal=np.full((40, 40, 3), 3**-0.5, np.float32)),
    "2x2": make_sheet(np.ones((2, 2), dtype=bool), diffuse_albedo=np.full((2, 2, 3), 0.5, dtype=np.float32)),
    "parts": dataclasses.replace(make_ball(), part=np.where(np.arange(24) < 12, 1, 2).astype(np.uint8) * np.ones((24, 1), np.uint8)),
    "many vertices": make_sheet(np.ones((260, 260), dtype=bool)),
}


def random_surface(rng: np.random.Generator) -> SurfaceMaps:
    """Noise of any height in a mask with holes, seen by any camera, with any layers: valid input, however unlikely."""
    shape = rows, cols = tuple(rng.integers(2, 24, 2).tolist())
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    pose = np.vstack([np.column_stack([turn, rng.normal(size=3)]), [0, 0, 0, 1]])
    fields = {"resolution": (cols, rows), "world_from_camera": pose.tolist() if rng.random() < 0.5 else None}
    height = rng.normal(size=shape) * 10 ** rng.uniform(-4, 2)
    if rng.random() < 0.5:
        camera = Camera(projection="perspective", focal_px=tuple(rng.uniform(20, 200, 2)), **fields)
        height = -np.abs(height) - 1e-3
    else:
        camera = Camera(projection="orthographic", pixel_size_m=10 ** rng.uniform(-6, 0) if rng.random() < 0.5 else None, **fields)
    normal = rng.normal(size=(*shape, 3))
    layers = {"normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True), "diffuse_albedo": 1.3 * rng.random((*shape, 3)),
              "specular": rng.random((*shape, 3)), "roughness": rng.random(shape), "part": rng.integers(1, 4, shape).astype(np.uint8)}
    kept = {name: layer if name == "part" else layer.astype(np.float32) for name, layer in layers.items() if rng.random() < 0.7}
    return SurfaceMaps(camera=camera, mask=rng.random(shape) < rng.choice([0.6, 0.9, 1]), height=height.astype(np.float32), **kept)
