"""The textures of a fused surface: what the views show at each texel, blended from those that see it best."""

import numpy as np
import warp as wp

from kernels.fusion.gather import gather
from kernels.fusion.rasterise import rasterise
from kernels.fusion.views import upload_views
from service.asset.content.mesh import SurfaceMesh
from service.asset.content.tangent import vertex_tangents
from service.asset.content.textures import BakedImages, TangentNormals
from service.scans.fusion.boxes import boxes
from service.scans.fusion.fused_surface import upload_layers
from service.scans.fusion.range_images import ALBEDO, COLOUR, NORMAL, ROUGHNESS, SPECULAR, PreparedScan, channels
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps

SLACK_VOXELS = 3.0
"""Distance, in voxels, by which the simplified mesh may lie off the surface that a view measured and still show it."""


def bake(mesh: SurfaceMesh, scans: list[PreparedScan], names: tuple[str, ...], voxel: float, px: int, *, device: str) -> BakedImages:
    """Blend the layers (`names`) of the scans that were fused over the texture of a mesh with texture coordinates, in the world frame."""
    texels = np.stack([mesh.st[:, 0], 1 - mesh.st[:, 1]], axis=-1).astype(np.float64) * px
    face, weights = rasterise(texels, mesh.triangles, px, px, device=device)
    covered = face >= 0
    corners = mesh.triangles[face[covered]]

    def between(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkx->nx", weights, values[corners])

    points, normals = between(mesh.points.astype(np.float64)), _unit(between(mesh.normals))
    values, known = _gathered(points, normals, scans, names, voxel, device)
    place = channels(names)

    def image(name: str) -> tuple[np.ndarray, np.ndarray]:
        columns, alpha = values[:, place[name]], values[:, place[name].stop]
        there = known & (alpha > 0)
        picture, mask = np.zeros((px, px, columns.shape[1]), dtype=np.float32), np.zeros((px, px), dtype=bool)
        picture[covered] = np.where(there[:, None], columns / np.where(there, alpha, 1)[:, None], 0)
        mask[covered] = there
        return picture, mask

    base = ALBEDO if ALBEDO in names else COLOUR
    layers = {name: image(name) for name in (base, SPECULAR, ROUGHNESS) if name in names}
    mask = layers[base][1] if base in layers else np.zeros((px, px), dtype=bool)
    maps = SurfaceMaps(
        camera=Camera(projection="orthographic", resolution=(px, px), pixel_size_m=1.0), mask=mask,
        diffuse_albedo=layers[base][0] if base in layers else None, specular=layers[SPECULAR][0] if SPECULAR in layers else None,
        roughness=layers[ROUGHNESS][0][..., 0] if ROUGHNESS in layers else None)
    shown = values[:, place[NORMAL]]
    known &= np.linalg.norm(shown, axis=1) > 0
    tangent = between(vertex_tangents(mesh))
    tangent = _unit(tangent - normals * np.einsum("nx,nx->n", tangent, normals)[:, None])
    a, b, c = (mesh.st[corners[:, k]].astype(np.float64) for k in range(3))
    turn = np.sign((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])  # −1 in a mirrored chart
    bitangent = np.cross(normals, tangent) * turn[:, None]
    unit = _unit(np.where(known[:, None], shown, normals))
    local = np.stack([np.einsum("nx,nx->n", axis, unit) for axis in (tangent, bitangent, normals)], axis=-1)
    normal, normal_known = np.zeros((px, px, 3), dtype=np.float32), np.zeros((px, px), dtype=bool)
    normal[covered] = local / 2 + 0.5
    normal_known[covered] = known & tangent.any(axis=1)
    return BakedImages(maps, TangentNormals(normal, normal_known), float(known.mean()) if len(known) else 0.0)


def _gathered(points: np.ndarray, normals: np.ndarray, scans: list[PreparedScan], names: tuple[str, ...], voxel: float,
              device: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the blended layers [n, C] at points, and where a view shows one, box by box."""
    width = channels(names)[names[-1]].stop + (names[-1] != NORMAL)
    values, known = np.zeros((len(points), width), dtype=np.float32), np.zeros(len(points), dtype=bool)
    for box in boxes(np.floor(points / voxel).astype(np.int64), scans, voxel, np.zeros(3)):
        low = np.array(box.corner) * voxel
        views = upload_views([scan.image.cropped(*window) for _, scan, window in box.watching], low, device=device)
        layers, feathers = upload_layers(box.watching, device)
        shown = gather(views, layers, feathers, wp.array((points[box.chosen] - low).astype(np.float32), dtype=wp.vec3, device=device),
                       wp.array(normals[box.chosen].astype(np.float32), dtype=wp.vec3, device=device),
                       wp.zeros(len(box.chosen), dtype=float, device=device), vectors=3, slack=SLACK_VOXELS * voxel, device=device)
        values[box.chosen], known[box.chosen] = shown.values.numpy(), shown.weight.numpy() > 0
        for each in box.watching:
            each.scan.release()
    return values, known


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
