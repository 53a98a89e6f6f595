"""RANSAC + ICP of two files, as a user of Open3D writes it: imports, files, features, pose.

    python benchmarks/speed/open3d_script.py a.ply b.ply VOXEL

What `benchmarks.speed.shell` times beside the shell command. It stands alone, so that its start imports
Open3D and nothing of this project; accuracy is measured with `jaxreg.evaluation.baselines`.
"""

import sys

import open3d as o3d


def described(path: str, voxel: float):
    """A file, thinned, and its features."""
    cloud = o3d.io.read_point_cloud(path)
    few = cloud.voxel_down_sample(voxel)
    few.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
    near = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
    return cloud, few, o3d.pipelines.registration.compute_fpfh_feature(few, near)


def main(source: str, reference: str, voxel: float) -> None:
    """Prints the pose."""
    method = o3d.pipelines.registration
    (a, few_a, of_a), (b, few_b, of_b) = (described(path, voxel) for path in (source, reference))
    found = method.registration_ransac_based_on_feature_matching(
        few_a, few_b, of_a, of_b, True, 1.5 * voxel,
        method.TransformationEstimationPointToPoint(False), 3,
        [
            method.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            method.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
        ],
        method.RANSACConvergenceCriteria(100_000, 0.999),
    )  # fmt: skip
    b.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
    refined = method.registration_icp(
        a, b, 0.4 * voxel, found.transformation, method.TransformationEstimationPointToPlane()
    )
    print(refined.transformation)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
