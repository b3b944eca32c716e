"""Multiway registration of scans with Open3D, as its tutorials and its reconstruction system do it; run by benchmarks/scans.py.

python scans_open3d.py SCANS.npz

Features (FPFH) and RANSAC for every pair, point-to-plane ICP from coarse to fine, information matrices, and a global optimisation
that prunes pairs. A pair is refused as in the reconstruction system where less than 0.3 of its points match. Prints poses and seconds
as JSON.
"""

import json
import sys
import time
from itertools import combinations

import numpy as np
import open3d as o3d

EXTENT_CELLS = 60
"""The cells of the rough scale across a scan, as benchmarks.scans has them."""
FINE = (0.25, 0.1)
"""Distances of the last two levels of ICP in cells."""
MATCHED = 0.3


def main() -> None:
    """Register the scans of a file."""
    reg = o3d.pipelines.registration
    held = np.load(sys.argv[1])
    points = [held[name].astype(np.float64) for name in sorted(held.files)]
    began = time.process_time()
    low_high = [np.percentile(each, (1, 99), axis=0) for each in points]
    cell = float(np.median([np.linalg.norm(high - low) for low, high in low_high])) / EXTENT_CELLS
    clouds, rough, features = [], [], []
    for each in points:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(each))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(16))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        thin = cloud.voxel_down_sample(cell)
        thin.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=2 * cell, max_nn=30))
        thin.orient_normals_towards_camera_location(np.zeros(3))
        clouds.append(cloud)
        rough.append(thin)
        features.append(reg.compute_fpfh_feature(thin, o3d.geometry.KDTreeSearchParamHybrid(radius=5 * cell, max_nn=100)))
    graph = reg.PoseGraph()
    graph.nodes.append(reg.PoseGraphNode(np.eye(4)))
    placed = np.eye(4)
    held_by = {0}
    for a, b in combinations(range(len(points)), 2):
        pose = reg.registration_ransac_based_on_feature_matching(
            rough[a], rough[b], features[a], features[b], True, 1.5 * cell, reg.TransformationEstimationPointToPoint(False), 3,
            [reg.CorrespondenceCheckerBasedOnEdgeLength(0.9), reg.CorrespondenceCheckerBasedOnDistance(1.5 * cell)],
            reg.RANSACConvergenceCriteria(100_000, 0.999)).transformation
        pose = reg.registration_icp(rough[a], rough[b], 1.5 * cell, pose, reg.TransformationEstimationPointToPlane()).transformation
        for reach in FINE:
            pose = reg.registration_icp(clouds[a], clouds[b], max(reach * cell, 1e-3), pose, reg.TransformationEstimationPointToPlane(),
                                        reg.ICPConvergenceCriteria(1e-9, 1e-9, 50)).transformation
        information = reg.get_information_matrix_from_point_clouds(clouds[a], clouds[b], FINE[-1] * cell, pose)
        matched = information[5, 5] / min(len(points[a]), len(points[b])) >= MATCHED
        if b == a + 1:
            placed = pose @ placed
            graph.nodes.append(reg.PoseGraphNode(np.linalg.inv(placed)))
            graph.edges.append(reg.PoseGraphEdge(a, b, pose, information, uncertain=False))
            held_by |= {a, b}
        elif matched:
            graph.edges.append(reg.PoseGraphEdge(a, b, pose, information, uncertain=True))
    o3d.pipelines.registration.global_optimization(
        graph, reg.GlobalOptimizationLevenbergMarquardt(), reg.GlobalOptimizationConvergenceCriteria(),
        reg.GlobalOptimizationOption(max_correspondence_distance=FINE[-1] * cell, edge_prune_threshold=0.25, reference_node=0))
    seconds = time.process_time() - began
    print(json.dumps({"poses": {number: graph.nodes[number].pose.tolist() for number in held_by}, "seconds": seconds}))


if __name__ == "__main__":
    main()
