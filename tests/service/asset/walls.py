"""A wall that a depth camera saw, with a hole and a lone column of pixels."""

import numpy as np

from stage.capture.camera import Camera
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps

CAMERA = Camera.model_validate({"projection": "perspective", "resolution": [24, 16], "focal_px": [40.0, 40.0]})


def make(broken=False, camera=CAMERA, **layers):
    depth = np.full((16, 24), 1.2, np.float32) + 0.002 * np.arange(24, dtype=np.float32)
    if broken:
        depth[:, 12:] += 0.8
    mask = np.ones((16, 24), bool)
    mask[0, 0], mask[5:7, 8] = False, False
    return DepthMaps(camera=camera, mask=mask, depth=np.where(mask, depth, 0), provenance={"relit:capture": "wall"}, **layers)


def cloud_of(maps, normals=False):
    points = maps.camera.points(-maps.depth)[maps.mask]
    colours = np.random.default_rng(1).integers(0, 256, (len(points), 3)).astype(np.uint8)
    return PointCloud(points, colours, np.tile(np.float32([0, 0, 1]), (len(points), 1)) if normals else None)


def uncertain():
    rng = np.random.default_rng(2)
    return {"sigma": rng.uniform(1e-3, 2e-3, (16, 24)).astype(np.float32), "confidence": rng.random((16, 24)).astype(np.float32)}
