"""TSDF fusion of range images with Open3D's VoxelBlockGrid; run by benchmarks/many_views.py and benchmarks/scan_pictures.py.

python fusion_open3d.py IMAGES.npz MESH.npz VOXEL_M

Every image is integrated into the blocks that its depths touch, with a truncation of four voxels, and the mesh is extracted where at
least one image measured. IMAGES.npz is as `benchmarks.fusion --depths` writes it. Writes the vertices (`points`) and faces; prints the
seconds of all processors as JSON, without reading.
"""

import json
import sys
import time

import numpy as np
import open3d as o3d
import open3d.core as o3c

TRUNCATION_VOXELS = 4.0
FARTHEST_M = 100.0
BLOCKS = 400_000
"""The blocks of 8³ voxels that there is room for."""


def main() -> None:
    """Fuse the images of a file."""
    held = np.load(sys.argv[1])
    depths, poses, focals = held["depth"], held["pose"], held["focal"]
    looks_along = np.diag([1.0, -1.0, -1.0, 1.0])  # Open3D's cameras look along +z, with +y down
    began = time.process_time()
    grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), (o3c.float32, o3c.float32), ((1), (1)), voxel_size=float(sys.argv[3]),
                                         block_resolution=8, block_count=BLOCKS, device=o3c.Device("CPU:0"))
    for depth, pose, focal in zip(depths, poses, focals, strict=True):
        rows, cols = depth.shape
        # a voxel takes the depth of the pixel that it falls into by truncation, so that whole numbers are the corners of pixels
        camera = o3c.Tensor([[focal, 0, cols / 2], [0, focal, rows / 2], [0, 0, 1]], dtype=o3c.float64)
        camera_from_world = o3c.Tensor(np.ascontiguousarray(np.linalg.inv(pose @ looks_along)))
        image = o3d.t.geometry.Image(o3c.Tensor(np.ascontiguousarray(depth[..., None])))
        blocks = grid.compute_unique_block_coordinates(image, camera, camera_from_world, 1.0, FARTHEST_M, TRUNCATION_VOXELS)
        grid.integrate(blocks, image, camera, camera_from_world, 1.0, FARTHEST_M, TRUNCATION_VOXELS)
    mesh = grid.extract_triangle_mesh(1.0)
    points, faces = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    seconds = time.process_time() - began
    np.savez(sys.argv[2], points=points, faces=faces)
    print(json.dumps({"seconds": seconds}))


if __name__ == "__main__":
    main()
