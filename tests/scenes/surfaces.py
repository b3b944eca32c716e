"""Surfaces with a closed form, as the solver would hand them over."""

import numpy as np

from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps

RADIUS_M = 0.08


def make_ball(size: int = 24, **changes) -> SurfaceMaps:
    """A hemisphere of RADIUS_M about the camera-frame origin, orthographic and metric, every layer present."""
    camera = Camera(projection="orthographic", resolution=(size, size), pixel_size_m=0.2 / size)
    x, y = camera.plane_coordinates()
    z2 = RADIUS_M**2 - x**2 - y**2
    mask = z2 > 0.1 * RADIUS_M**2  # no rim: there the surface turns away within one pixel
    z = np.sqrt(np.where(mask, z2, 0))
    normal = np.stack([x, y, z], axis=-1) / RADIUS_M
    albedo = np.stack([0.2 + 0.6 * (x > 0), np.full_like(x, 0.5), 0.3 + 0.5 * (y > 0)], axis=-1)
    layers = {"normal": normal, "diffuse_albedo": albedo, "specular": np.full_like(normal, 0.04),
              "roughness": np.full_like(x, 0.35), "height": z}
    kept = {name: np.where(mask if layer.ndim == 2 else mask[..., None], layer, 0).astype(np.float32)
            for name, layer in layers.items()}
    return SurfaceMaps(**{"camera": camera, "mask": mask, "provenance": {"relit:method": "svbrdf"}, **kept, **changes})


def make_wave(projection: str = "perspective", **camera_changes) -> SurfaceMaps:
    """A wavy sheet that fills an off-centre image of 30 by 20 pixels; non-square pixels where perspective."""
    fields = {"resolution": (30, 20), "principal_px": (13.25, 11.5)}
    if projection == "perspective":
        fields |= {"focal_px": (70.0, 75.0), "surface_z_m": -0.9}
    camera = Camera(**{"projection": projection, **fields, **camera_changes})
    u, v = np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5)
    wave = 0.02 * np.sin(u / 3) * np.cos(v / 4)
    height = wave - 0.9 if projection == "perspective" else wave
    return SurfaceMaps(camera=camera, mask=np.ones(u.shape, dtype=bool), height=height.astype(np.float32))


def make_sheet(mask: np.ndarray, **layers) -> SurfaceMaps:
    """A flat sheet at z = 0 with this mask, one metre per pixel."""
    camera = Camera(projection="orthographic", resolution=mask.shape[::-1], pixel_size_m=1.0)
    return SurfaceMaps(camera=camera, mask=mask, height=np.zeros(mask.shape, dtype=np.float32), **layers)
