"""Real scans, against Open3D and KISS-Matcher on the same pairs.

    python -m benchmarks.scans.red_kitchen --data-root DATA [--rotation full] [--pairs 20]

Fragments of 7Scenes whose overlap is 0.5 or more, the source turned by up to 30 degrees (or by any
rotation) about its centroid and moved. Success is an error below 15 degrees and 0.3 m. The peers get
the voxel size that suits these scans (5 cm); jaxreg gets no setting.
"""

import dataclasses
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.data.seven_scenes import read_fragment
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans.pair import register

VOXEL = 0.05


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    rotation: Literal["limited", "full"] = "limited"
    """Up to 30 degrees, or any rotation."""
    pairs: int = 20
    overlap: float = 0.5
    seed: int = 0
    only: str = ""
    """Run the methods whose names contain this."""


def scan_pairs(folder: Path, overlap: float) -> list[tuple[int, int, np.ndarray]]:
    """(i, j, T) of the pairs with enough overlap; T maps fragment j into the frame of fragment i."""
    rows = [line.split() for line in (folder / "gt_overlap.txt").read_text().splitlines()[1:]]
    enough = {
        (int(i), int(j))
        for name, i, j, a, b, *_ in rows
        if name == "3DMatch" and (float(a) + float(b)) / 2 >= overlap
    }
    lines = (folder / "gt.log").read_text().splitlines()
    found = []
    for k in range(0, len(lines), 5):
        i, j = (int(x) for x in lines[k].split()[:2])
        if (i, j) in enough:
            found.append((i, j, np.array([row.split() for row in lines[k + 1 : k + 5]], float)))
    return found


def turned(points: np.ndarray, rng: np.random.Generator, rotation: str) -> np.ndarray:
    """A random 4x4 motion about the centroid of `points`."""
    if rotation == "full":
        turn = Rotation.random(random_state=rng)
    else:
        axis = rng.normal(size=3)
        angle = np.radians(rng.uniform(0, 30))
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    motion, centre = np.eye(4), points.mean(axis=0)
    motion[:3, :3] = turn.as_matrix()
    motion[:3, 3] = centre - turn.apply(centre) + rng.uniform(-0.5, 0.5, 3)
    return motion


def ours(rotation: str) -> Callable:
    """Jaxreg as anybody would call it."""
    return lambda x, y: register(x, y, rotation=rotation)


def described(x: np.ndarray, y: np.ndarray):
    """Both clouds reduced to voxels, with normals to the inside, and FPFH, as in Open3D's tutorial."""
    import open3d as o3d

    clouds, features = [], []
    for points in (x, y):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * VOXEL, 30))
        # To one side that turns along with the cloud; see jaxreg.classical.open3d_baselines.
        cloud.orient_normals_towards_camera_location(cloud.get_center())
        around = o3d.geometry.KDTreeSearchParamHybrid(5 * VOXEL, 100)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, around))
        clouds.append(cloud)
    return clouds, features


def ransac_icp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """FPFH + RANSAC + ICP with the parameters of Open3D's tutorial."""
    import open3d as o3d

    pipelines = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    clouds, features = described(x, y)
    coarse = pipelines.registration_ransac_based_on_feature_matching(
        *clouds,
        *features,
        True,
        1.5 * VOXEL,
        pipelines.TransformationEstimationPointToPoint(False),
        3,
        [
            pipelines.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            pipelines.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL),
        ],
        pipelines.RANSACConvergenceCriteria(100000, 0.999),
    )
    return open3d_icp(clouds, coarse.transformation)


def fgr_icp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fast global registration + ICP with the parameters of Open3D's tutorial."""
    import open3d as o3d

    pipelines = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    clouds, features = described(x, y)
    option = pipelines.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * VOXEL)
    coarse = pipelines.registration_fgr_based_on_feature_matching(*clouds, *features, option)
    return open3d_icp(clouds, coarse.transformation)


def open3d_icp(clouds, initial: np.ndarray) -> np.ndarray:
    """Point-to-plane ICP of Open3D, from a coarse pose."""
    import open3d as o3d

    pipelines = o3d.pipelines.registration
    return pipelines.registration_icp(
        *clouds,
        0.4 * VOXEL * 2,
        initial,
        pipelines.TransformationEstimationPointToPlane(),
    ).transformation


def kiss_icp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """KISS-Matcher, then ICP."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL))
    solution = matcher.estimate(x.astype(np.float32), y.astype(np.float32))
    initial = np.eye(4)
    initial[:3, :3], initial[:3, 3] = solution.rotation, np.asarray(solution.translation).ravel()
    return open3d_icp(described(x, y)[0], initial)


def methods(options: Options) -> dict[str, Callable]:
    """The methods that can run here."""
    found = {"jaxreg": ours(options.rotation)}
    if importlib.util.find_spec("open3d"):
        found["Open3D FPFH+RANSAC+ICP"] = ransac_icp
        found["Open3D FGR+ICP"] = fgr_icp
        if importlib.util.find_spec("kiss_matcher"):
            found["KISS-Matcher+ICP"] = kiss_icp
    return {name: method for name, method in found.items() if options.only in name}


def main(options: Options) -> None:
    """Print a line a method, and the pairs that it fails."""
    process.enable_compilation_cache()
    folder = Path(data_root(options.data_root)) / "7scene" / "7-scenes-redkitchen"
    rng = np.random.default_rng(options.seed)
    cases = []
    for i, j, truth in scan_pairs(folder, options.overlap)[: options.pairs]:
        x, y = (read_fragment(folder / f"cloud_bin_{k}.ply") for k in (j, i))
        motion = turned(x, rng, options.rotation)
        moved = x @ motion[:3, :3].T + motion[:3, 3]
        cases.append((i, j, moved, y, truth @ np.linalg.inv(motion)))
    for name, method in methods(options).items():
        method(*cases[0][2:4])
        report(name, method, cases)


def report(name: str, method: Callable, cases: list) -> None:
    """Run a method on every case and print what came out."""
    errors, seconds, notes, said = [], [], [], []
    for i, j, x, y, truth in cases:
        begin = time.perf_counter()
        result = method(x, y)
        seconds.append(time.perf_counter() - begin)
        matrix = getattr(result, "transformation", result)
        angle = rotation_angle_deg(matrix[:3, :3], truth[:3, :3])
        centre = x.mean(axis=0)
        shift = np.linalg.norm((matrix - truth)[:3, :3] @ centre + (matrix - truth)[:3, 3])
        errors.append((angle, shift))
        good = angle < 15 and shift < 0.3
        verdict = getattr(result, "success", None)
        said.append((good, verdict))
        if not good or verdict is False:
            flag = "" if verdict is None else f" said {verdict} (p {result.probability:.2f})"
            notes.append(f"{i}-{j}: {angle:.1f} deg {shift:.2f} m{flag}")
    good = [a < 15 and s < 0.3 for a, s in errors]
    angles = np.array(errors)[good, 0]
    middle = np.median(angles) if len(angles) else np.nan
    print(
        f"{name:26s} success {np.mean(good):.2f} of {len(cases)}  median {middle:.2f} deg  "
        f"time {np.median(seconds):.2f} s (median) {np.max(seconds):.2f} (max)",
        flush=True,
    )
    for note in notes:
        print(f"    {note}")


if __name__ == "__main__":
    main(tyro.cli(Options))
