"""Open3D's ICP, FGR and FPFH + RANSAC: as papers print them, as its tutorial runs them, and tuned.

All lengths derive from one, `spacing`, by the ratios of Open3D's tutorial on global registration
(https://www.open3d.org/docs/release/tutorial/pipelines/global_registration.html) to its voxel size:
normals within 2 of it, FPFH within 5, RANSAC inliers within 1.5, FGR inliers within 0.5. The default
suits 1024 points on a unit sphere.

`open3d_icp`, `open3d_icp_point_to_plane`, `open3d_fgr` and `open3d_fpfh_ransac` are rows that
papers print, for the clouds as they are; ICP pairs points within 10 of `spacing`.
`open3d_icp_coarse_to_fine`, `open3d_fgr_gicp` and `open3d_ransac_gicp` add a refinement within 2
and then 0.6 of it, until it has converged. `open3d_ransac_icp`, `open3d_fgr_icp` and
`open3d_fgr_icp_default` are the tutorial: features of voxels of `spacing`, then point-to-plane ICP
on the whole clouds with Open3D's own criteria.

Measurements show that the differences from the tutorial are to Open3D's advantage. Normals point
away from the centre of the cloud: see `_oriented`. Clouds that are no denser than the voxels
(`_are_dense`) stay as they are, instead of losing every fifth point, and their ICP pairs points
within 2 and then 1 of `spacing` instead of 0.4, within which most of their points have no
neighbour. FGR has `decrease_mu`, as in its authors' own program
(https://github.com/isl-org/FastGlobalRegistration); Open3D's default for Python leaves it off; then
the distance has no effect and every outlier keeps its pull. `open3d_fgr_icp_default` does that, as
in the tutorial.

Every function takes a source (n, 3) and a reference (m, 3) and raises ValueError when a cloud is
not finite, not (n, 3), or has fewer than three points, and when Open3D is not installed. Random
samples are seeded: the same call gives the same transform (GICP to 1e-9, as its sums are threaded).
"""

from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from jaxreg.evaluation.baselines.library import library
from jaxreg.geometry.clouds import check_points
from jaxreg.types import RigidTransform

SPACING = 0.05
"""Roughly the distance between neighbours of 1024 points on a unit sphere."""
_NORMAL_NEIGHBORS, _FPFH_NEIGHBORS = 30, 100
_ICP_ITERATIONS, _ICP_TOLERANCE = 100, 1e-9
"""Open3D stops after 30 iterations, or at 1e-6, which leaves most exact copies unfinished."""
Coarse = Literal["fgr", "fgr_default", "ransac"]
_RANSAC_ITERATIONS, _RANSAC_CONFIDENCE = 100_000, 0.999


def icp(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    to_plane: bool = False,
    fine: bool = False,
) -> RigidTransform:
    """ICP from the identity, to points or planes; with `fine`, then with the overlap's pairs only."""
    clouds = _clouds(source, reference, spacing)
    estimation = _registration().TransformationEstimationPointToPlane() if to_plane else None
    pose = _icp(*clouds, np.eye(4), 10 * spacing, estimation)
    return _transform(_refine(_icp, *clouds, pose, spacing) if fine else pose)


def from_features(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    coarse: Coarse,
    refinement: Literal["none", "icp", "gicp"],
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """Match FPFH (Rusu, Blodow and Beetz, 2009), find a pose from the matches, and refine it.

    `coarse` is fast global registration (Zhou, Park and Koltun, 2016) or RANSAC over triplets of
    matches; `refinement` "icp" is the tutorial, with features of voxels.
    """
    whole = described = _clouds(source, reference, spacing)
    if refinement == "icp" and _are_dense(*whole, spacing):
        one, other = (_oriented(cloud.voxel_down_sample(spacing), spacing) for cloud in whole)
        described = (one, other)
    pose = _coarse(*described, coarse, spacing=spacing, seed=seed)
    if refinement == "icp":
        pose = _to_plane(*whole, pose, spacing)
    if refinement == "gicp":
        pose = _refine(_gicp, *whole, pose, spacing)
    return _transform(pose)


def refined(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    initial: Float[np.ndarray, "4 4"],
    *,
    spacing=SPACING,
) -> RigidTransform:
    """The tutorial's point-to-plane ICP from a pose that another program found."""
    return _transform(_to_plane(*_clouds(source, reference, spacing), initial, spacing))


def require() -> Any:
    """The module `open3d`, silenced.

    Raises:
      ValueError: it is not installed.
    """
    open3d = library("open3d", "Open3D")
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _registration() -> Any:
    return require().pipelines.registration


def _clouds(source: np.ndarray, reference: np.ndarray, spacing: float) -> tuple[Any, Any]:
    if not spacing > 0:
        raise ValueError(f"spacing = {spacing} must be positive: the distance between points.")
    return _cloud(source, "source", spacing), _cloud(reference, "reference", spacing)


def _cloud(points: np.ndarray, name: str, spacing: float) -> Any:
    open3d = require()
    points, _ = check_points(points, name)
    return _oriented(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)), spacing)


def _oriented(cloud: Any, spacing: float) -> Any:
    """The cloud with normals that point away from its centre."""
    open3d = require()
    cloud.estimate_normals(
        open3d.geometry.KDTreeSearchParamHybrid(radius=2 * spacing, max_nn=_NORMAL_NEIGHBORS)
    )
    # FPFH depends on the side that a normal points to, and Open3D leaves that to the axes: under a
    # rotation, half of the normals change sides. The side away from the centre turns with the cloud.
    cloud.orient_normals_towards_camera_location(cloud.get_center())
    cloud.normals = open3d.utility.Vector3dVector(-np.asarray(cloud.normals))
    return cloud


def _fpfh(cloud: Any, spacing: float) -> Any:
    search = require().geometry.KDTreeSearchParamHybrid(radius=5 * spacing, max_nn=_FPFH_NEIGHBORS)
    return _registration().compute_fpfh_feature(cloud, search)


def _coarse(
    source: Any, reference: Any, method: Coarse, *, spacing: float, seed: int
) -> np.ndarray:
    require().utility.random.seed(seed)
    features = _fpfh(source, spacing), _fpfh(reference, spacing)
    if method == "ransac":
        return _ransac(source, reference, *features, spacing)
    module = _registration()
    option = module.FastGlobalRegistrationOption(
        decrease_mu=method == "fgr", maximum_correspondence_distance=0.5 * spacing
    )
    return module.registration_fgr_based_on_feature_matching(
        source, reference, *features, option
    ).transformation


def _ransac(
    source: Any, reference: Any, source_fpfh: Any, reference_fpfh: Any, spacing: float
) -> np.ndarray:
    module, distance = _registration(), 1.5 * spacing
    return module.registration_ransac_based_on_feature_matching(
        source,
        reference,
        source_fpfh,
        reference_fpfh,
        True,  # Mutual matches only.
        distance,
        module.TransformationEstimationPointToPoint(False),
        3,
        [
            module.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            module.CorrespondenceCheckerBasedOnDistance(distance),
        ],
        module.RANSACConvergenceCriteria(_RANSAC_ITERATIONS, _RANSAC_CONFIDENCE),
    ).transformation


def _are_dense(source: Any, reference: Any, spacing: float) -> bool:
    """Whether both clouds have more than two points per voxel, as scans do in the tutorial."""
    return all(
        2 * len(cloud.voxel_down_sample(spacing).points) < len(cloud.points)
        for cloud in (source, reference)
    )


def _to_plane(source: Any, reference: Any, initial: np.ndarray, spacing: float) -> np.ndarray:
    module = _registration()
    for distance in (0.4,) if _are_dense(source, reference, spacing) else (2, 1):
        initial = module.registration_icp(
            source,
            reference,
            distance * spacing,
            initial,
            module.TransformationEstimationPointToPlane(),
        ).transformation
    return initial


def _refine(method, source: Any, reference: Any, initial: np.ndarray, spacing: float) -> np.ndarray:
    near = method(source, reference, initial, 2 * spacing)
    return method(source, reference, near, 0.6 * spacing)


def _icp(source, reference, initial: np.ndarray, distance: float, estimation=None) -> np.ndarray:
    module = _registration()
    estimation = estimation or module.TransformationEstimationPointToPoint()
    return module.registration_icp(
        source, reference, distance, initial, estimation, _criteria()
    ).transformation


def _gicp(source, reference, initial: np.ndarray, distance: float) -> np.ndarray:
    module = _registration()
    estimation = module.TransformationEstimationForGeneralizedICP()
    return module.registration_generalized_icp(
        source, reference, distance, initial, estimation, _criteria()
    ).transformation


def _criteria() -> Any:
    return _registration().ICPConvergenceCriteria(_ICP_TOLERANCE, _ICP_TOLERANCE, _ICP_ITERATIONS)


def _transform(matrix: np.ndarray) -> RigidTransform:
    matrix = np.array(matrix)
    return RigidTransform(matrix[:3, :3], matrix[:3, 3])
