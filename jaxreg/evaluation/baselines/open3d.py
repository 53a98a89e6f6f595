"""Open3D's ICP, FGR and FPFH + RANSAC: as papers print them, as its tutorial runs them, and tuned.

All lengths derive from one, `spacing`, by the ratios of Open3D's tutorial on global registration
(https://www.open3d.org/docs/release/tutorial/pipelines/global_registration.html) to its voxel size:
normals within 2 of it, FPFH within 5, RANSAC inliers within 1.5, FGR inliers within 0.5. The default
suits 1024 points on a unit sphere.

`icp`, `icp_point_to_plane`, `fgr` and `fpfh_ransac` are the rows that papers print, of the clouds as
they are; ICP pairs points within 10 of `spacing`. `icp_coarse_to_fine`, `fgr_gicp` and `ransac_gicp`
add a refinement within 2 and then 0.6 of it that runs until it has converged. `ransac_icp`, `fgr_icp`
and `fgr_icp_default` are the tutorial: features of voxels of `spacing`, then point-to-plane ICP on the
whole clouds with Open3D's own criteria.

What differs from the tutorial is to Open3D's advantage, as measured. Normals point away from the
centre of the cloud: see `_oriented`. Clouds that are no denser than the voxels (`_are_dense`) stay as
they are, instead of losing every fifth point, and their ICP pairs points within 2 and then 1 of
`spacing` in place of 0.4, within which most of their points have no neighbour. FGR has `decrease_mu`,
as in its authors' own program (https://github.com/isl-org/FastGlobalRegistration); Open3D's default for
Python is without, where the distance has no effect and every outlier keeps its pull. That, as in the
tutorial, is `fgr_icp_default`.

Every function takes a source (n, 3) and a reference (m, 3) and raises ValueError when a cloud is
not finite, not (n, 3), or has fewer than three points, and when Open3D is not installed. Random
samples are seeded: the same call gives the same transform (GICP to 1e-9, as its sums are threaded).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.geometry.clouds import check_points
from jaxreg.types import RigidTransform

SPACING = 0.05
"""About the distance between neighbours of 1024 points on a unit sphere."""
_NORMAL_NEIGHBORS, _FPFH_NEIGHBORS = 30, 100
_ICP_ITERATIONS, _ICP_TOLERANCE = 100, 1e-9
"""Open3D stops after 30 iterations, or at 1e-6, which leaves most exact copies unfinished."""
_RANSAC_ITERATIONS, _RANSAC_CONFIDENCE = 100_000, 0.999


def icp(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, spacing=SPACING
) -> RigidTransform:
    """Point-to-point ICP from the identity."""
    clouds = _clouds(source, reference, spacing)
    return _transform(_icp(*clouds, np.eye(4), 10 * spacing))


def icp_point_to_plane(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, spacing=SPACING
) -> RigidTransform:
    """Point-to-plane ICP from the identity."""
    clouds = _clouds(source, reference, spacing)
    estimation = _registration().TransformationEstimationPointToPlane()
    return _transform(_icp(*clouds, np.eye(4), 10 * spacing, estimation))


def icp_coarse_to_fine(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, spacing=SPACING
) -> RigidTransform:
    """Point-to-point ICP, then again with the pairs of the overlap only."""
    clouds = _clouds(source, reference, spacing)
    coarse = _icp(*clouds, np.eye(4), 10 * spacing)
    return _transform(_refine(_icp, *clouds, coarse, spacing))


def fgr(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """Fast global registration (Zhou, Park and Koltun, 2016) on FPFH."""
    return _transform(_fgr(*_clouds(source, reference, spacing), spacing, seed))


def fgr_icp(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """FGR, then ICP, as in the tutorial but for `decrease_mu`, which its authors set."""
    return _tutorial(_fgr, source, reference, spacing=spacing, seed=seed)


def fgr_icp_default(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """FGR, then ICP, as in the tutorial: all options that it does not name are Open3D's defaults."""
    return _tutorial(_fgr_default, source, reference, spacing=spacing, seed=seed)


def fgr_gicp(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """FGR refined by generalised ICP."""
    clouds = _clouds(source, reference, spacing)
    return _transform(_refine(_gicp, *clouds, _fgr(*clouds, spacing, seed), spacing))


def fpfh_ransac(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """RANSAC over triplets of FPFH matches (Rusu, Blodow and Beetz, 2009)."""
    return _transform(_ransac(*_clouds(source, reference, spacing), spacing, seed))


def ransac_icp(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """FPFH + RANSAC, then ICP, as in the tutorial."""
    return _tutorial(_ransac, source, reference, spacing=spacing, seed=seed)


def ransac_gicp(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    spacing=SPACING,
    seed: int = 0,
) -> RigidTransform:
    """FPFH + RANSAC refined by generalised ICP."""
    clouds = _clouds(source, reference, spacing)
    return _transform(_refine(_gicp, *clouds, _ransac(*clouds, spacing, seed), spacing))


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
    try:
        import open3d
    except ImportError as error:
        raise ValueError(
            f'this baseline needs Open3D ({error}): pip install "jaxreg[baselines]".'
        ) from None
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
    # FPFH depends on the side that a normal points to, and Open3D leaves that to the axes: turned by
    # any rotation, half of the normals change sides. Away from the centre is a side that turns along.
    cloud.orient_normals_towards_camera_location(cloud.get_center())
    cloud.normals = open3d.utility.Vector3dVector(-np.asarray(cloud.normals))
    return cloud


def _fpfh(cloud: Any, spacing: float) -> Any:
    search = require().geometry.KDTreeSearchParamHybrid(radius=5 * spacing, max_nn=_FPFH_NEIGHBORS)
    return _registration().compute_fpfh_feature(cloud, search)


def _fgr(
    source: Any, reference: Any, spacing: float, seed: int, *, decrease_mu: bool = True
) -> np.ndarray:
    require().utility.random.seed(seed)
    module = _registration()
    return module.registration_fgr_based_on_feature_matching(
        source,
        reference,
        _fpfh(source, spacing),
        _fpfh(reference, spacing),
        module.FastGlobalRegistrationOption(
            decrease_mu=decrease_mu, maximum_correspondence_distance=0.5 * spacing
        ),
    ).transformation


def _fgr_default(source: Any, reference: Any, spacing: float, seed: int) -> np.ndarray:
    return _fgr(source, reference, spacing, seed, decrease_mu=False)


def _ransac(source: Any, reference: Any, spacing: float, seed: int) -> np.ndarray:
    require().utility.random.seed(seed)
    module, distance = _registration(), 1.5 * spacing
    return module.registration_ransac_based_on_feature_matching(
        source,
        reference,
        _fpfh(source, spacing),
        _fpfh(reference, spacing),
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


def _tutorial(
    coarse: Callable[[Any, Any, float, int], np.ndarray],
    source: np.ndarray,
    reference: np.ndarray,
    *,
    spacing: float,
    seed: int,
) -> RigidTransform:
    """A coarse pose of the thinned clouds, refined on the whole ones."""
    whole = x, y = _clouds(source, reference, spacing)
    if _are_dense(*whole, spacing):
        x, y = (_oriented(cloud.voxel_down_sample(spacing), spacing) for cloud in whole)
    return _transform(_to_plane(*whole, coarse(x, y, spacing, seed), spacing))


def _are_dense(source: Any, reference: Any, spacing: float) -> bool:
    """Whether both clouds have more than two points a voxel, as scans do in the tutorial."""
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
